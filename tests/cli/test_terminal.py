"""Names in files and configurations do not steer the terminal."""

import io
import logging
import sys

import pytest
from cli_runner import typed
from tqdm import tqdm

from suspnet.cli import check, evaluate, folders, program, train
from suspnet.ground import progress
from suspnet.ground.storage import printable

STEERING = "\x1b[31m\x1b]0;title\x07\r\x9b2J\u202e\u2066\u200f\x00\x7f"
"""Colour, the title of the window, the start of the line, a blank screen, and writing reversed."""
SHOWN = r"\x1b[31m\x1b]0;title\x07\r\x9b2J\u202e\u2066\u200f\x00\x7f"


def steers(text):
    """Return whether a text holds more than printable characters, ends of lines and tabs."""
    return any(not letter.isprintable() and letter not in "\n\t" for letter in text)


def test_control_characters_are_shown_as_escapes():
    assert printable(f"trip {STEERING}") == f"trip {SHOWN}"
    plain = "two\nlines\tand \N{GREEK SMALL LETTER OMEGA} \N{RIGHTWARDS ARROW} \N{BRAIN}"
    assert printable(plain) == plain


def test_what_is_printed_and_logged_steers_nothing(monkeypatch):
    out, err = io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    with progress.visible():
        print(f"| {STEERING} |\n| next line |")
        handler = logging.StreamHandler()
        handler.emit(logging.makeLogRecord({"msg": "trip %s", "args": (STEERING,)}))
    assert out.getvalue() == f"| {SHOWN} |\n| next line |\n"
    assert err.getvalue() == f"trip {SHOWN}\n"
    assert sys.stdout is out


def test_progress_bars_replace_their_line():
    plain, wrapped = io.StringIO(), io.StringIO()
    for stream in (plain, progress.Visible(wrapped)):
        for _ in tqdm(range(3), file=stream, mininterval=0, bar_format="{n}"):
            with tqdm(range(2), file=stream, position=1, mininterval=0, bar_format="{n}") as inner:
                list(inner)
    assert wrapped.getvalue() == plain.getvalue()
    assert "\r" in plain.getvalue()
    assert "\x1b[A" in plain.getvalue()


def test_error_of_a_hostile_name_is_one_plain_line(monkeypatch, capsys):
    def fails():
        raise SystemExit(f"error: {STEERING}")

    with pytest.raises(SystemExit) as ended:
        program.run(fails)
    assert ended.value.code == f"error: {SHOWN}"

    def interrupted():
        folders.to_resume[:] = [f"outputs/{STEERING}"]
        raise KeyboardInterrupt

    with pytest.raises(SystemExit):
        program.run(interrupted)
    folders.to_resume.clear()
    assert not steers(capsys.readouterr().err)


NAMES = {
    "a trip": (check, lambda folder: [folder / f"trip{STEERING.replace(chr(0), '')}.yaml"]),
    "a folder": (check, lambda folder: [folder / "trips"]),
    "a run": (evaluate, lambda folder: ["run='a\x1b[31mb'", "trips=trips"]),
    "a key": (train, lambda folder: ["model.\x1b[31mC=3"]),
    "an experiment": (train, lambda folder: ["experiment='\x1b[31m'"]),
    "a configuration": (train, lambda folder: [f"--config-dir={folder}", "experiment=evil"]),
}


@pytest.mark.representatives(3)
@pytest.mark.parametrize(("module", "arguments"), NAMES.values(), ids=NAMES)
def test_programs_print_hostile_names_as_escapes(module, arguments, tmp_path):
    trips = tmp_path / "trips"
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "evil.yaml").write_text(
        '# @package _global_\nprotocol: {name: "a\\e[31mb"}\ngroup: "\\e]0;x\\a"\n'
        'model: {C: "\\e[2J"}'
    )
    trips.mkdir()
    words = 'vehicle: "\\e[31mred"\nsuspension: "\\e]0;x\\a"\nchannels: {"\\e[2J": {file: "\\r"}}\n'
    for name in ("trip_\x1b[31m.yaml", "trip_2.yaml"):
        (trips / name).write_text(words)
    (tmp_path / f"trip{STEERING.replace(chr(0), '')}.yaml").write_text(words)
    ended = typed(module, *arguments(tmp_path), cwd=tmp_path)
    assert ended.returncode == 1
    assert ended.stdout + ended.stderr
    assert not steers(ended.stdout + ended.stderr)
