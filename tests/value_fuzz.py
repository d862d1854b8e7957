"""Sets one key of a program's configuration to a value that a user may mistype, many times over.

As a script: python value_fuzz.py PROGRAM N_VALUES SEED FOLDER prints the counts as JSON.
"""

import io
import json
import math
import random
import resource
import signal
import sys
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

from cli_runner import run_composed
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from suspnet.cli import evaluate, simulate, train
from suspnet.cli.program import CONFIGS

MODULES = {"train": train, "evaluate": evaluate, "simulate": simulate}
VALUES = [
    *(math.nan, math.inf, -math.inf, 1e30, -1e30, 1e300, 1e19, 1e-300, -1, 0, 1, 0.5, 3, 2.5e5),
    *(10**9, 10**12, 10**30, "abc", "", "no", "nan", "../x", "\0", "ü", "1e3", None, True, False),
    *([], [1, 2], [0.0, math.nan], [[1.0]], ["a"], {}, {"a": 1}, {"k_p": [1]}, "${nowhere}", "???"),
]
"""What each key is set to."""
SECONDS = 3.0
"""Time after which a program that has neither ended nor complained is at work, and is ended."""
MEMORY_BYTES = 12 << 30
TINY = ["data.n_train=64", "data.n_test=32", "progress=false", "threads=1"]
SHORT = ["fleet.n_trips=1", "fleet.minutes=0.1", "workers=1", "progress=false"]
SLOW_SENSORS = [f"fleet.sensors.{name}.rate_hz=200" for name in ("axle_box", "bogie", "body")]
SLOW_SENSORS += ["fleet.minutes=8", "fleet.n_stops=0"]
BASES = {
    "train": [
        [*TINY, "data.n_calibrate=100", "model.n_components=16", "figures=false", "refine=true"],
        [*TINY, "data.n_calibrate=null", "model=svr", "figures=false"],
        [*TINY, "data.n_calibrate=null", "model=mvgpr", "protocol=paper", "figures=false"],
        [*TINY, "data.n_calibrate=null", "model=curve_fit", "protocol=joint", "figures=false"],
        [*TINY, "data.n_calibrate=null", "model=linear", "experiment=trips", "figures=false"],
        [*TINY, "data.n_calibrate=null", "search=table5", "figures=false"],
    ],
    "evaluate": [
        ["run={run}", "data.n_test=32", "progress=false", "threads=1"],
        ["run={trips_run}", "trips={trips}", "progress=false", "monitor.workers=1"],
    ],
    "simulate": [
        [*SHORT],
        [*SHORT, *SLOW_SENSORS, "generator=quarter_car", "scatter=0", "fleet.journey=service"],
        [*SHORT, "scenario=random", "generator=vertical_vehicle", "fleet.sides=left"],
    ],
}
"""Command lines whose keys are changed: small enough to be run through."""


class AtWork(BaseException):
    """The program passed its checks and works on."""


def composed(program, overrides, folder):
    """Return a configuration with Hydra's block, and the keys of all its values."""
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        config = compose(
            program,
            overrides=[*overrides, f"hydra.runtime.output_dir={folder}"],
            return_hydra_config=True,
        )
    return config, list(keys(config, ""))


def keys(node, path):
    """Yield the path of each value and mapping at or below a node, Hydra's block left out."""
    for key in node:
        name = f"{path}.{key}".lstrip(".")
        if name == "hydra" or name.endswith(".kind"):
            continue
        yield name
        plain = not OmegaConf.is_interpolation(node, key) and not OmegaConf.is_missing(node, key)
        if plain and isinstance(node[key], DictConfig):
            yield from keys(node[key], name)


@contextmanager
def limited(seconds):
    """Raise AtWork when the time is over."""

    def over(*_):
        raise AtWork

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def outcome(module, config):
    """Run a program on a configuration; return how it ended and the words of a failure."""
    try:
        with (
            limited(SECONDS),
            redirect_stdout(io.StringIO()),
            redirect_stderr(io.StringIO()),
            warnings.catch_warnings(record=True),
        ):
            module.main(config)
    except AtWork:
        return "at work", ""
    except SystemExit as ended:
        one = ended.code
        fine = not isinstance(one, str) or (one.startswith("error: ") and "\n" not in one)
        return ("refused", "") if fine else ("many lines", one)
    except Exception:
        return "traceback", traceback.format_exc()
    return "ran", ""


def unchanged(module, config, folder):
    """Run a program as it is: it must work, and imports what it needs without a limit of time."""
    config = config.copy()
    if "out" in config:
        config.out = str(folder / "out")
    config.hydra.runtime.output_dir = str(folder)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        del config["hydra"]
    folder.mkdir(parents=True)
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        try:
            module.main(config)
        except SystemExit as ended:
            if isinstance(ended.code, str):
                raise ValueError(ended.code) from None


def prepare(folder):
    """Make the runs and the trip that evaluate.py reads; return their places."""
    quick = [*TINY, "data.n_calibrate=100", "model=linear", "figures=false"]
    run_composed(train, folder / "run", *quick)
    run_composed(train, folder / "trips_run", *quick, "experiment=trips")
    short = ["fleet.n_trips=1", "fleet.minutes=1", "generator=quarter_car", "workers=1"]
    trips = folder / "trips"
    run_composed(simulate, folder / "simulated", *short, f"out={trips}", "progress=false")
    return {"run": folder / "run", "trips_run": folder / "trips_run", "trips": trips}


def fuzz(program, n_values, seed, folder, n_bases=None):
    """Try values on keys, drawn without replacement; return counts and what failed."""
    module, draw = MODULES[program], random.Random(seed)
    places = prepare(folder) if program == "evaluate" else {}
    bases = [[text.format(**places) for text in base] for base in BASES[program][:n_bases]]
    found = [composed(program, base, folder / "output") for base in bases]
    cases = [
        (i, key, value) for i, (_, names) in enumerate(found) for key in names for value in VALUES
    ]
    for i, (config, _) in enumerate(found):
        unchanged(module, config, folder / f"unchanged_{i}")
    counts, failures = Counter(), []
    for n, (i, key, value) in enumerate(draw.sample(cases, min(n_values, len(cases)))):
        config = found[i][0].copy()
        with open_dict(config):
            config.hydra.runtime.output_dir = str(folder / "output" / str(n))
            OmegaConf.update(config, key, value, merge=False, force_add=True)
            if program == "simulate" and key != "out":
                config.out = str(folder / "out" / str(n))
        HydraConfig.instance().set_config(config)
        with open_dict(config):
            del config["hydra"]
        Path(folder / "output" / str(n)).mkdir(parents=True)
        ended, words = outcome(module, config)
        counts[ended] += 1
        if words:
            failures.append({"base": bases[i], "key": key, "value": repr(value), "words": words})
    return {"keys": len({key for _, key, _ in cases}), **counts}, failures


if __name__ == "__main__":
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    counts, failures = fuzz(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4]))
    print(json.dumps({"counts": counts, "failures": failures}))
