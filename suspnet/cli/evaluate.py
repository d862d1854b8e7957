"""Score trained models on fresh curves, or read trips with them: suspnet-evaluate run=PATH."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from suspnet.cli import program
from suspnet.cli.named_runs import named_runs
from suspnet.estimation.checkpoint import load_model
from suspnet.ground.limits import Severity
from suspnet.ground.storage import write_atomically
from suspnet.history import History
from suspnet.maintenance.state import State
from suspnet.report.overview import Evaluated
from suspnet.runs.evaluate import FreshCurves, evaluate
from suspnet.runs.sweeps import write_table6
from suspnet.trips.fleet import evaluate_fleet

FINE, MISTAKE, SOME_WITHOUT_ESTIMATE, NOTICE, ACT = 0, 1, 2, 3, 4
"""Exit codes: nothing to tell; a user's mistake; a trip without an estimate, or a parameter that
cannot be judged; and the alarms."""
BY_URGENCY = (FINE, SOME_WITHOUT_ESTIMATE, NOTICE, MISTAKE, ACT)
"""Exit codes, the worst last: after a mistake trips are unread, which may be worse than a
notice."""
ALARMS = {
    Severity.UNKNOWN: SOME_WITHOUT_ESTIMATE,
    Severity.NOTICE: NOTICE,
    Severity.ACT: ACT,
}
EXIT_CODE = "exit_code"
"""Name of the file in the folder of each job of a multirun that holds its exit code."""


def worst(codes: Iterable[int]) -> int:
    """Return the most urgent of some exit codes; one that is not ours counts as a mistake."""
    known = (code if code in BY_URGENCY else MISTAKE for code in codes)
    return max(known, key=BY_URGENCY.index, default=FINE)


def exit_code(done: Sequence[Evaluated]) -> int:
    """Return the exit code that some suspensions ask for."""
    codes = [ALARMS.get(one.severity, FINE) for one in done]
    return worst([*codes, *(SOME_WITHOUT_ESTIMATE for one in done if not one.is_complete)])


class WorstExitCode(Callback):
    """Ends a multirun with the worst exit code of its jobs."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Read what the jobs left in their folders, and exit."""
        files = sorted(Path(config.hydra.sweep.dir).glob(f"*/{EXIT_CODE}"))
        code = worst(int(file.read_text()) for file in files)
        if code:
            sys.exit(code)


def ends_with_its_code(function: Callable[[DictConfig], int]) -> Callable[[DictConfig], None]:
    """Wrap a task that returns its exit code: exit with it, or keep it until all jobs are done.

    In a multirun a mistake is printed, and the other jobs run.
    """

    @functools.wraps(function)
    def wrapped(config: DictConfig) -> None:
        several = HydraConfig.get().mode == RunMode.MULTIRUN
        try:
            code = function(config)
        except SystemExit as ended:
            if not several:
                raise
            print(ended.code, file=sys.stderr)
            code = MISTAKE
        if several:
            write_atomically(program.run_folder() / EXIT_CODE, f"{code}\n")
        elif code:
            sys.exit(code)

    return wrapped


@hydra.main(version_base="1.3", config_path=program.CONFIGS, config_name="evaluate")
@ends_with_its_code
@program.task
def compose(config: DictConfig) -> int:
    """Run a study, read trips or score the models of a run; return the exit code."""
    if OmegaConf.is_missing(config, "run"):
        raise ValueError("which run? Give run=PATH, the folder of a run or of a whole multirun")
    if config.study is not None:
        program.n_threads(config.threads)
        program.save_config(config, program.run_folder())
        found = program.build(config, "study", folder=program.run_folder())
        severities = [one.severity for one in found if isinstance(one, State)]
        return worst(ALARMS.get(one, FINE) for one in severities)
    runs, output = named_runs(config.run), program.run_folder()
    program.save_config(config, output)
    if config.trips is not None:
        models = [load_model(folder, config.device) for folder in runs]
        settings = program.build(config, "monitor", _convert_="all")
        with ExitStack() as stack:
            store = config.store and stack.enter_context(History(config.store))
            trips = Path(config.trips)
            done = evaluate_fleet(
                trips, models, output, settings, config.progress, store, config.seed, config.figures
            )
        return exit_code(done)
    if not isinstance(config.data, DictConfig):
        raise ValueError(f"`data` holds data.n_test and data.snr_db, got {config.data!r}")
    fresh = FreshCurves(
        seed=config.seed,
        n_test=config.data.n_test,
        snr_db=config.data.snr_db,
        protocol=program.build(config, "protocol") if config.get("protocol") else None,
        threads=program.n_threads(config.threads),
        progress=config.progress,
    )
    results = [
        evaluate(
            folder,
            output / folder.name if len(runs) > 1 else output,
            fresh,
            device=config.device,
            figures=config.figures,
        )
        for folder in runs
    ]
    if len(results) > 1:
        write_table6(results, output)
    return FINE


def main() -> None:
    """Run the program."""
    program.run(compose)
