"""Runs the programs: composed or as typed in this process, or as a command in another."""

import io
import json
import logging
import signal
import subprocess
import sys
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure
from omegaconf import open_dict

from suspnet.cli import program
from suspnet.cli.program import CONFIGS, DEBUG
from suspnet.runs import scores, sweeps

ROOT = Path(__file__).parents[1]
FEW = ["data.n_train=150", "data.n_test=60", "data.n_calibrate=100"]
QUIET = ["progress=false", "figures=false"]
SMALL = [*FEW, "data.step_hz=0.05", *QUIET]


def run_composed(module, folder, *overrides):
    """Compose and run a program in this process; its run folder is `folder`."""
    name = module.__name__.rpartition(".")[2]
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        output = f"hydra.runtime.output_dir={folder}"
        config = compose(name, overrides=[*overrides, output], return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        del config["hydra"]
    folder.mkdir(parents=True, exist_ok=True)
    module.main(config)


def run_main(module, folder, *overrides):
    """Do as `run_composed` does and return the run's metrics."""
    run_composed(module, folder, *overrides)
    return json.loads((folder / "metrics.json").read_text())


def run_program(module, folder, *overrides):
    """Do as `run_composed` does and return the exit code, or the last words."""
    try:
        run_composed(module, folder, *overrides)
    except SystemExit as ended:
        return ended.code
    return 0


class _NoPlots:
    """Makes an empty figure of whatever is to be plotted."""

    def __getattr__(self, name):
        return lambda *_, **__: Figure(figsize=(1, 1))


@contextmanager
def blank_figures(*, made=False):
    """Leave figures blank: to draw them takes longest, as to make those of training does.

    Those of training are made, though not drawn, if `made`; one run that does so is enough.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "draw", lambda *_: None)
        if not made:
            for module in (scores, sweeps):
                patch.setattr(module, "plots", _NoPlots())
        yield


def typed(module, *arguments, cwd, **variables):
    """Run a program in this process as if typed in the folder `cwd`, and return how it ended.

    Many times faster than `command`, which waits for Python and torch to start.
    """
    name = module.__name__.rpartition(".")[2]
    argv = [f"{name}.py", *map(str, arguments)]
    code = 0
    with (
        pytest.MonkeyPatch.context() as patch,
        _logging_set_back(),
        redirect_stdout(io.StringIO()) as out,
        redirect_stderr(io.StringIO()) as err,
    ):
        patch.chdir(cwd)
        patch.setattr(sys, "argv", argv)
        for key, value in ({DEBUG: ""} | variables).items():  # the program sets it: set it back
            patch.setenv(key, value)
        try:
            program.main(name)
        except SystemExit as ended:
            code = ended.code or 0
            if isinstance(code, str):
                print(code, file=sys.stderr)
                code = 1
    return subprocess.CompletedProcess(argv, code, out.getvalue(), err.getvalue())


@contextmanager
def _logging_set_back():
    """Set back the root logger, which Hydra gives handlers of its own."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        yield
    finally:
        for handler in set(root.handlers) - set(handlers):
            handler.close()
        root.handlers[:] = handlers
        root.setLevel(level)


@contextmanager
def handlers_set_back():
    """Set back the handlers of signals, which a program that starts sets for its whole process."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def command(program, *overrides, launcher=(), cwd=ROOT, **options):
    """Run train.py or evaluate.py in a process of its own and return how it ended."""
    return python(*launcher, ROOT / program, *overrides, cwd=cwd, **options)


def python(*arguments, cwd, timeout=200, **options):
    """Run Python in a process of its own and return how it ended."""
    return subprocess.run(
        [sys.executable, *map(str, arguments)],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=timeout,
        check=False,
        **options,
    )
