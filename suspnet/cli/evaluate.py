"""Score trained models on fresh curves, or read trips with them: suspnet-evaluate run=PATH."""

from __future__ import annotations

import functools
import logging
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from shlex import quote

from omegaconf import DictConfig, OmegaConf

from suspnet.cli import program
from suspnet.cli.folders import ACT, EXIT_CODE, FINE, NOTICE, SOME_WITHOUT_ESTIMATE, is_job, worst
from suspnet.cli.kinds import board_settings, build, named_runs
from suspnet.cli.rigs import evaluate_rig, is_rig_run
from suspnet.estimation.checkpoint import load_model
from suspnet.ground.extras import check_extra, optional
from suspnet.ground.parameters import Severity
from suspnet.ground.settings import check_choice
from suspnet.ground.storage import write_atomically
from suspnet.runs.evaluate import FreshCurves, evaluate
from suspnet.runs.language import speaking
from suspnet.runs.sweeps import write_table6

with optional("trips"):
    from suspnet.depot.live.notifier import Notifier, read_rules
    from suspnet.trains.history import History
    from suspnet.trains.jobs.fleet import evaluate_fleet
    from suspnet.trains.jobs.maintenance import existing_history, write_maintenance
    from suspnet.trains.pages.overview import Evaluated

log = logging.getLogger(__name__)
STUDIES = ("maintenance",)
ALARMS = {Severity.UNKNOWN: SOME_WITHOUT_ESTIMATE, Severity.NOTICE: NOTICE, Severity.ACT: ACT}


def exit_code(done: Sequence[Evaluated]) -> int:
    """Return the exit code for the worst of some suspensions."""
    codes = [ALARMS.get(suspension.severity, FINE) for suspension in done]
    if not all(suspension.is_complete for suspension in done):
        codes.append(SOME_WITHOUT_ESTIMATE)
    return worst(codes)


def ends_with_its_code(function: Callable[[DictConfig], int]) -> Callable[[DictConfig], None]:
    """Wrap a task that returns its exit code: exit with it, or store it in a multirun."""

    @functools.wraps(function)
    def wrapped(config: DictConfig) -> None:
        code = function(config)
        if is_job():
            write_atomically(program.run_folder() / EXIT_CODE, f"{code}\n")
        elif code:
            sys.exit(code)

    return wrapped


@ends_with_its_code
@program.task
def main(config: DictConfig) -> int:
    """Run a study, read trips or score the models of a run; return the exit code."""
    of_trips = config.trips, config.store, config.notify
    if config.study == "maintenance" or any(value is not None for value in of_trips):
        check_extra("trips")
    rules = None if config.notify is None else read_rules(Path(config.notify))
    if rules is not None and not config.store:
        raise ValueError("`notify` needs store=FILE: what is new is found in the history")
    with ExitStack() as stack:

        @functools.cache  # opened when it is needed first, and once
        def history() -> History:
            opened = existing_history if config.study is not None else History
            return stack.enter_context(opened(config.store))

        with speaking(config.language):
            code = _evaluate(config, history)
        if rules is not None:
            log.info("alarms: %d messages sent, %d failed", *Notifier(history(), rules).once())
        return code


def _evaluate(config: DictConfig, history: Callable[[], History]) -> int:
    if OmegaConf.is_missing(config, "run"):
        raise ValueError("which run? Give run=PATH, the folder of a run or of a whole multirun")
    if config.study is not None:
        return run_study(config, program.run_folder(), history)
    if is_rig_run(config.run):
        urgent = evaluate_rig(config, program.run_folder())
        return worst(ALARMS.get(severity, FINE) for severity in urgent)
    runs, output = named_runs(config.run), program.run_folder()
    program.save_config(config, output)
    if config.trips is None:
        _score(config, runs, output)
        return FINE
    models = [load_model(folder, config.device) for folder in runs]
    trips, settings = Path(config.trips), build(config, "monitor")
    store = history() if config.store else None
    options = config.progress, store, config.seed, config.figures
    return exit_code(evaluate_fleet(trips, models, output, settings, *options))


def _score(config: DictConfig, runs: Sequence[Path], output: Path) -> None:
    """Score the models of some runs on fresh curves, and compare several in Table VI."""
    if not isinstance(config.data, DictConfig):
        raise ValueError(f"`data` holds data.n_test and data.snr_db, got {config.data!r}")
    fresh = FreshCurves(
        seed=config.seed,
        n_test=config.data.n_test,
        snr_db=config.data.snr_db,
        threads=program.n_threads(config.threads),
        progress=config.progress,
    )
    options = {"device": config.device, "figures": config.figures}
    results = [
        evaluate(run, output / run.name if len(runs) > 1 else output, fresh, **options)
        for run in runs
    ]
    if len(results) > 1:
        write_table6(results, output)
    if not is_job():
        log.info("see it with: tensorboard --logdir %s", quote(str(output)))


def run_study(config: DictConfig, folder: Path, history: Callable[[], History]) -> int:
    """Run the chosen study, some of which need the history; return its exit code."""
    check_choice("study", config.study, STUDIES)
    program.save_config(config, folder)
    states = write_maintenance(history(), folder, board_settings(config, config.monitor))
    return worst(ALARMS.get(state.severity, FINE) for state in states)
