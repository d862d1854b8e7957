"""The command suspnet: each program by its name, help at once, completion in real shells."""

import os
import pty
import select
import shutil
import subprocess
import sys
import time

import pytest
from cli_runner import ROOT, handlers_set_back

from suspnet import __version__
from suspnet.cli import command, completion
from suspnet.cli.start import PROGRAMS

SLOW = {"hydra", "numpy", "torch", "yaml", "scipy", "matplotlib"}
"""What the help of the command must not import."""
IMPORTED = "import sys; sys.argv = ['suspnet', '--help']; from suspnet.cli.command import main;"
AT_THE_END = "main(); print(*sys.modules, file=sys.stderr)"
CASES = {
    "suspnet ev": ["evaluate"],
    "suspnet completion z": ["zsh"],
    "suspnet train experiment=ta": ["table5", "table6"],
    "suspnet train data.min": ["data.minutes="],
    "suspnet train healthy=trips/ca": ["trips/car7"],
    "suspnet evaluate study=layo": ["layouts"],
    "suspnet check tri": ["trips"],
    "suspnet train healthy=Wa": ["Wagen 7, hinten"],
    "suspnet check --no": ["--no-pictures"],
    "suspnet history fleet.db ackn": ["acknowledge"],
    "suspnet init suspension": ["suspension="],
    "suspnet nothing": [],
}
"""What is typed, and what bash adds, which takes what follows = for a word of its own."""


def started(monkeypatch, *words):
    """Return the program that the command starts, and its arguments."""
    found = []
    monkeypatch.setattr(command, "start", lambda name: found.append((name, sys.argv)))
    monkeypatch.setattr(sys, "argv", ["/bin/suspnet", *words])
    command.main()
    return found[0]


def test_each_program_has_its_name_and_a_line_of_help():
    assert set(command.MEANINGS) == set(PROGRAMS)
    assert all(f"\n  {name} " in command.HELP for name in PROGRAMS)


def test_arguments_reach_the_program(monkeypatch):
    name, argv = started(monkeypatch, "train", "healthy=a b", "-m", "--help")
    assert (name, argv) == ("train", ["/bin/suspnet-train", "healthy=a b", "-m", "--help"])


def test_help_imports_nothing_that_takes_time():
    ended = subprocess.run(
        [sys.executable, "-c", IMPORTED + AT_THE_END],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert ended.stdout.startswith("Usage: suspnet PROGRAM")
    assert not SLOW & {name.partition(".")[0] for name in ended.stderr.split()}


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["trian"], "no program 'trian': did you mean train? suspnet --help"),
        (["xyzzy"], "no program 'xyzzy': suspnet --help lists them"),
        (["completion"], "say for which shell: suspnet completion bash or zsh"),
        (["completion", "fish"], "say for which shell"),
    ],
)
def test_mistake_is_one_line(monkeypatch, words, text):
    monkeypatch.setattr(sys, "argv", ["suspnet", *words])
    with pytest.raises(SystemExit) as ended:
        command.main()
    assert text in str(ended.value)


def test_version_is_that_of_the_package(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["suspnet", "--version"])
    command.main()
    assert capsys.readouterr().out == f"suspnet {__version__}\n"


def test_program_runs_under_the_command(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["suspnet", "check", "--help"])
    with handlers_set_back(), pytest.raises(SystemExit) as ended:
        command.main()
    assert not ended.value.code
    assert capsys.readouterr().out.startswith("usage: suspnet check")


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
def test_words_are_completed_in_bash(tmp_path):
    (tmp_path / "trips" / "car7").mkdir(parents=True)
    (tmp_path / "Wagen 7, hinten").mkdir()
    (tmp_path / "words.sh").write_text(completion.script("bash"))
    asked = [
        f'COMP_LINE="{line}"; COMP_POINT=${{#COMP_LINE}}; COMPREPLY=(); _suspnet 2>/dev/null;'
        'printf "%s|" "${COMPREPLY[@]}"; echo'
        for line in CASES
    ]
    code = "\n".join(["source words.sh", *asked])
    done = subprocess.run(
        ["bash", "--norc", "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    found = [[word for word in line.split("|") if word] for line in done.stdout.splitlines()]
    assert found == list(CASES.values())
    assert done.stderr == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shell", "options"), [("bash", ["--norc", "-i"]), ("zsh", ["-f", "-i"])], ids=["bash", "zsh"]
)
def test_words_are_completed_at_a_prompt(shell, options, tmp_path):
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell}")
    (tmp_path / "trips" / "car7").mkdir(parents=True)
    (tmp_path / "words").write_text(completion.script(shell))
    for typed, seen in {
        "suspnet ev\t": "suspnet evaluate",
        "suspnet train healthy=trips/ca\t": "healthy=trips/car7",
        "suspnet train data.min\t": "data.minutes=",
        "suspnet check --no\t": "--no-pictures",
    }.items():
        assert seen in answered([shell, *options], typed, tmp_path)


def answered(shell, typed, folder):
    """Return what a shell shows within 2 s after a key is pressed."""
    child, terminal = pty.fork()
    if not child:
        os.chdir(folder)
        os.environ["TERM"] = "dumb"
        os.execvp(shell[0], shell)
    shown = ""
    for words in (". ./words\n", typed):
        os.write(terminal, words.encode())
        last = time.monotonic() + 2.0
        while time.monotonic() < last:
            if select.select([terminal], [], [], 0.1)[0]:
                shown += os.read(terminal, 2**16).decode(errors="replace")
    os.kill(child, 9)
    os.waitpid(child, 0)
    os.close(terminal)
    return shown
