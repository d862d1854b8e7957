"""The command suspnet: each program by its name and help at once."""

import os
import subprocess
import sys

import pytest
from cli_runner import ROOT, handlers_set_back

from suspnet import __version__
from suspnet.cli import command
from suspnet.cli.start import PROGRAMS

SLOW = {"hydra", "numpy", "torch", "yaml", "scipy", "matplotlib"}
"""What the help of the command must not import."""
IMPORTED = "import sys; sys.argv = ['suspnet', '--help']; from suspnet.cli.command import main;"
AT_THE_END = "main(); print(*sys.modules, file=sys.stderr)"


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
