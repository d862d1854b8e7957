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
    monkeypatch.setattr(progress.Lines, "monitor_interval", 0.01)
    monkeypatch.setattr(progress.Lines, "monitor", None)
    caplog.set_level(logging.INFO, progress.log.name)
    yield lambda: caplog.messages
    if progress.Lines.monitor is not None:
        progress.Lines.monitor.exit()


def wait_for(lines, n):
    """Wait until there are so many lines, at most 10 s."""
    for _ in range(1000):
        if len(lines()) >= n:
            return
        time.sleep(0.01)


def test_items_are_counted_as_they_are_done(lines):
    bar = progress.bar("trips", 3, items=iter("abc"), unit="trip")
    counts = [bar.format_dict["n"] for _ in bar]
    assert counts == [0, 1, 2]
    assert bar.format_dict["n"] == 3


def test_what_is_done_and_what_remains(lines, monkeypatch):
    with progress.bar("training curves", 28_000, unit="curve") as bar:
        assert lines() == ["training curves: 0 of 28,000"]
        bar.start_t -= 90
        bar.update(12_000)
        wait_for(lines, 2)
    assert lines()[1] == "training curves: 12,000 of 28,000, 90 s, about 2 min left"
    bar = progress.bar("fit msvr", unit="step")
    bar.start_t -= 31
    bar.update(3)
    assert bar.text() == "fit msvr: step 3, 31 s"
    bar.close()


def test_remaining_time_shrinks_while_the_next_item_is_waited_for(lines):
    with progress.bar("suspensions", 2, unit="suspension") as bar:
        bar.start_t -= 540
        bar.update()
        seen = [bar.text()]
        for waited_s in (240, 299.5):
            bar.start_t -= waited_s
            seen.append(bar.text())
    assert seen == [
        "suspensions: 1 of 2, 9 min, about 9 min left",
        "suspensions: 1 of 2, 13 min, about 5 min left",
        "suspensions: 1 of 2, 18 min",  # longer than the first one: nothing is known
    ]


def test_terminal_has_a_bar_and_no_lines(lines, monkeypatch):
    terminal = io.StringIO()
    terminal.isatty = lambda: True
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress.bar("trips", 5, unit="trip") as bar:
        bar.update(5)
        time.sleep(0.2)
    with progress.bar("search of the vehicle"):
        pass
    assert lines() == []
    assert "trips: 100%" in terminal.getvalue()
    assert "5/5" in terminal.getvalue()
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
    r"\S+ training curves: 0 of 300",
    r"search of settings for msvr: 0 of \d+",
    r"fit msvr",
    r"calibration of intervals and flags",
    r"\S+ calibration curves: 0 of 100",
    r"fits of calibration curves: 0 of 100",
    r"test",
    r"\S+ test curves: 0 of 100",
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
    assert done.stderr.splitlines() == ["trips: 0 of 2"]
    assert done.stdout.startswith("2 trips of scenario")
