"""Lines that say how far a program is, where standard error is no terminal."""

import io
import logging
import logging.config
import re
import sys
import time
from pathlib import Path

import pytest
import yaml
from cli_runner import SMALL, typed

from suspnet.cli import simulate, train
from suspnet.cli.config_files import CONFIGS
from suspnet.ground import progress


@pytest.fixture
def lines(caplog, monkeypatch):
    """Let lines come 20 times a second, and return those so far."""
    monkeypatch.setattr(progress, "INTERVAL_S", 0.05)
    caplog.set_level(logging.INFO, progress.log.name)
    return lambda: caplog.messages


def test_log_has_a_line_at_the_start_and_then_from_time_to_time(lines):
    for _ in progress.bar("trips", 3, items=iter("abc"), unit="trip"):
        pass
    assert [line.partition(" [")[0] for line in lines()] == ["trips: 0 of 3"]
    with progress.bar("training curves", 28_000, unit="curve") as bar:
        bar.update(1000)
        time.sleep(0.1)
        with progress.bar("inner", unit="step") as inner:
            time.sleep(0.1)
            inner.update(3)
        bar.start_t -= 90
        bar.update(11_000)
    shown = [
        "training curves: 0 of 28000",
        "inner: 0",
        "inner: 3",
        "training curves: 12000 of 28000",
    ]
    assert [line.partition(" [")[0] for line in lines()[1:]] == shown
    assert re.search(r"\[01:30<02:\d\d\]$", lines()[-1])
    with progress.bar("fit", shown=False), progress.bar("trips", 0, unit="trip"):
        pass
    assert lines()[5:] == ["fit"]


def test_terminal_has_one_bar_that_leaves_no_line(lines, monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress.bar("trips", 5, unit="trip") as bar:
        time.sleep(0.2)
        bar.update(3)
    with progress.bar("search of the vehicle"):
        pass
    assert lines() == []
    assert "trips:  60%" in terminal.getvalue()
    assert "3/5" in terminal.getvalue()
    assert "\n" not in terminal.getvalue()
    assert "search of the vehicle: 00:00" in terminal.getvalue()


def test_lines_go_to_standard_error_and_results_to_standard_output(monkeypatch):
    out, err, file = io.StringIO(), io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stdout", out)
    monkeypatch.setattr(sys, "stderr", err)
    root = logging.Logger("root", logging.INFO)
    monkeypatch.setattr(logging, "getLogger", lambda *_: root)
    monkeypatch.setattr(progress.log, "parent", root)
    root.handlers = [logging.StreamHandler(out), logging.StreamHandler(file)]
    before = root.handlers[:]
    with progress.on_stderr("3: "):
        progress.stage("test")
        root.info("rms error 1 %")
    assert root.handlers == before
    assert out.getvalue() == "rms error 1 %\n"
    assert err.getvalue() == "3: test\n"
    assert file.getvalue() == "test\nrms error 1 %\n"


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("a\nalarm cleared", "a\\nalarm cleared"),
        ("a\r\nb", "a\\r\\nb"),
        ("a\N{LINE SEPARATOR}b", "a\\u2028b"),
        ("\x1b[2Ja", "\\x1b[2Ja"),
        ("\N{RIGHT-TO-LEFT OVERRIDE}a", "\\u202ea"),
        ("Züge 4", "Züge 4"),
    ],
)
def test_no_name_in_a_log_line_forges_another_line(name, shown):
    file = Path(CONFIGS, "base", "program.yaml")
    given = yaml.safe_load(file.read_text())["hydra"]["job_logging"]["formatters"]
    formatter = logging.config.DictConfigurator({}).configure_formatter(given["simple"])

    def text(form, *args):
        return formatter.format(logging.LogRecord("x", logging.INFO, "", 0, form, args, None))

    assert text("%s is %d", name, 3) == f"{shown} is 3"
    table = text("%s\n-> %s", "a | b\n1 | 2", name)
    assert table.startswith("a | b\n1 | 2\n-> ")


STAGES = [
    r"\S+ training curves: 0 of \d+",
    r"search of settings for msvr: 0 of \d+",
    r"fit msvr: 0",
    r"calibration of intervals and flags",
    r"\S+ calibration curves: 0 of \d+",
    r"fits of calibration curves: 0 of \d+",
    r"test",
    r"\S+ test curves: 0 of \d+",
    r"figures and tables of the run",
]


@pytest.mark.slow
def test_redirected_training_prints_its_steps_in_order(tmp_path, blank):
    search = ["search=table5", "search.grids.msvr.C=[1e3,1e4]", "search.grids.msvr.sigma=[4]"]
    done = typed(train, *SMALL, *search, "threads=1", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    printed = done.stderr.splitlines()
    at = [next(i for i, line in enumerate(printed) if re.fullmatch(one, line)) for one in STAGES]
    assert at == sorted(at)
    for one in STAGES:
        assert not re.search(f"^{one}$", done.stdout, re.MULTILINE)
    assert "Mean absolute error" in done.stdout or "mape" in done.stdout.lower()
    (log,) = tmp_path.glob("outputs/train/*/train.log")
    assert set(printed) <= set(log.read_text().splitlines())


def test_redirected_simulation_counts_its_trips(tmp_path):
    few = ["fleet.n_trips=2", "fleet.minutes=1", "workers=1", "out=trips"]
    rates = [f"fleet.sensors.{name}.rate_hz=200" for name in ("axle_box", "bogie", "body")]
    done = typed(simulate, *few, *rates, "progress=false", cwd=tmp_path)
    assert done.stderr.startswith("trips: 0 of 2\n")
    assert len(done.stderr.splitlines()) == 1
    assert done.stdout.startswith("2 trips of scenario")
