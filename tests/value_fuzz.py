"""Sets one key of a program's configuration to a value that a user may mistype, many times over."""

import io
import math
import random
import signal
import traceback
import warnings
from collections import Counter
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from suspnet.cli import simulate, train
from suspnet.cli.program import CONFIGS

MODULES = {"train": train, "simulate": simulate}
VALUES = [
    *(math.nan, math.inf, -math.inf, 1e30, -1e30, 1e300, 1e19, 1e-300, -1, 0, 1, 0.5, 3, 2.5e5),
    *(10**9, 10**12, 10**30, "abc", "", "no", "nan", "../x", "\0", "ü", "1e3", None, True, False),
    *([], [1, 2], [0.0, math.nan], [[1.0]], ["a"], {}, {"a": 1}, {"k_p": [1]}, "${nowhere}", "???"),
]
"""What each key is set to."""
SECONDS = 3.0
"""Time after which a program that has neither ended nor complained is at work, and is ended."""
BASES = {
    "train": [
        *("data.n_train=64", "data.n_test=32", "data.n_calibrate=100", "progress=false"),
        *("threads=1", "model.n_components=16", "figures=false", "refine=true"),
    ],
    "simulate": ["fleet.n_trips=1", "fleet.minutes=0.1", "workers=1", "progress=false"],
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


def fuzz(program, n_values, seed, folder):
    """Try values on keys, drawn without replacement; return counts and what failed."""
    module, draw = MODULES[program], random.Random(seed)
    base, names = composed(program, BASES[program], folder / "output")
    unchanged(module, base, folder / "unchanged")
    counts, failures = Counter(), []
    cases = [(key, value) for key in names for value in VALUES]
    for n, (key, value) in enumerate(draw.sample(cases, n_values)):
        config = base.copy()
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
            failures.append({"key": key, "value": repr(value), "words": words})
    return counts, failures
