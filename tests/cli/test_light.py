"""Without the extras: the paper's part works, and programs of trains say what to install."""

import os
import re
import subprocess
import sys
import tomllib

import pytest
from cli_runner import ROOT

from suspnet.ground.extras import PACKAGES

BLOCKED = sorted({name for packages in PACKAGES.values() for name in packages} - {"werkzeug"})
START = f"""
import sys
class Blocked:
    def find_spec(name, path=None, target=None):
        if name.partition(".")[0] in {BLOCKED}:  # as if it were not installed
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Blocked)
sys.argv = ["suspnet", *sys.argv[1:]]
"""
PAPER = """
import suspnet
from suspnet import MSVR, Problem, load_model, read_protocol, train
import suspnet.cli.train, suspnet.cli.evaluate, suspnet.runs.sweeps
problem = Problem(
    suspnet.QuarterCar(suspnet.read_vehicles()["am96"]),
    read_protocol("multi_location").task("primary"),
    suspnet.CurveSettings(n_train=60, n_test=20, n_calibrate=None, step_hz=0.1),
    seed=0,
)
metrics = train(problem, MSVR(C=100.0), "run", figures=False)
assert 0 < metrics["scores"]["k_p"]["mape_percent"] < 100
assert load_model("run").name == "msvr"
"""
PROGRAM = """
from suspnet.cli.command import main
main()
"""


def started(code, *words, cwd):
    return subprocess.run(
        [sys.executable, "-c", START + code, *words],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("extra", PACKAGES)
def test_what_is_said_to_be_missing_is_what_the_extra_installs(extra):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    named = " ".join(project["optional-dependencies"][extra])
    installed = set(re.findall(r"[\w-]+(?=>=)", named))
    assert {package.replace("_", "-") for package in PACKAGES[extra]} <= installed


def test_the_part_of_the_paper_needs_no_extra(tmp_path):
    """In the process that has done what the paper does, a program of trains says what it lacks."""
    done = started(PAPER + PROGRAM, "train", "healthy=x", cwd=tmp_path)
    assert_says_what_to_install(done, "trips")


def assert_says_what_to_install(done, extra):
    assert done.returncode == 1, done.stderr
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert f'pip install -e ".[{extra}]" in the folder of suspnet' in line


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "extra"),
    [
        (("train", "healthy=x"), "trips"),
        (("demo",), "trips"),
        (("check", "x"), "trips"),
        (("init", "x"), "trips"),
        (("simulate",), "trips"),
        (("evaluate", "run=x", "trips=x"), "trips"),
        (("history", "x", "list"), "trips"),
        (("monitor", "run=x"), "trips"),
        (("replay", "trips=x"), "trips"),
        (("serve", "store=x"), "live"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else value,
)
def test_programs_of_trains_say_in_one_line_what_to_install(words, extra, tmp_path):
    assert_says_what_to_install(started(PROGRAM, *words, cwd=tmp_path), extra)
