"""What `evaluate.py` does: score a model on fresh curves; plan a fleet from its history."""

from __future__ import annotations

import logging
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.problem import TEST, Problem
from suspnet.ground.progress import stage
from suspnet.ground.storage import write_json
from suspnet.history import History
from suspnet.history.database import check_exists
from suspnet.maintenance.fleet import fleet_state
from suspnet.maintenance.plan import plan_of
from suspnet.maintenance.state import State
from suspnet.report.board import BoardSettings
from suspnet.report.maintenance_figures import plan_calendar
from suspnet.report.output import write_fleet
from suspnet.report.overview import fleet_view, overview_table
from suspnet.report.tensorboard import RunLog
from suspnet.runs.predict import predict_stream
from suspnet.runs.scores import (
    Metrics,
    draw_predictions,
    headline,
    log_hyperparameters,
    report,
    scores,
)

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FreshCurves:
    """Curves for tests, on which no model was trained.

    `seed` must differ from those of the runs; `n_test` is a number or "all". `snr_db` is the run's
    own if None.
    """

    seed: int
    n_test: int | str
    snr_db: float | None = None
    threads: int = 1
    progress: bool = True

    def problem(self, model: FittedMethod, folder: Path) -> Problem:
        """Return the problem with these test curves, for the model of a run's folder.

        ValueError if the seed is the run's own.
        """
        if self.seed == model.training["seed"]:
            raise ValueError(
                f"seed={self.seed} made the training curves of {folder}; fresh curves need another "
                "seed"
            )
        settings = replace(model.settings, n_test=self.n_test)
        if self.snr_db is not None:
            settings = replace(settings, snr_db=self.snr_db)
        return Problem(
            model.generator, model.task, settings, self.seed, self.threads, self.progress
        )


def evaluate(
    folder: Path, output: Path, fresh: FreshCurves, *, device: str = "cpu", figures: bool = True
) -> Metrics:
    """Score the model in `folder` on fresh curves; write metrics and figures to `output`."""
    model = load_model(folder, device)
    problem = fresh.problem(model, folder)
    stage(f"test of {folder}")
    outcome = predict_stream(problem, model, TEST, flags=True)
    metrics = {
        **headline(problem, model),
        **scores(problem, model, outcome),
        "seconds": outcome.seconds,
        "run": str(folder),
    }
    with RunLog(output, is_new=True) as run_log:
        log_hyperparameters(run_log, metrics, model.training["parameters"])
        if figures:
            draw_predictions(problem, model.name, outcome, run_log, output / "figures")
    write_json(output / "metrics.json", metrics)
    report(metrics, output)
    return metrics


def find_runs(path: Path) -> list[Path]:
    """Return the folders with a model at or below `path`: one run, or all of a multirun.

    FileNotFoundError if there is none.
    """
    if not path.exists():
        raise FileNotFoundError(f"run={path} does not exist")
    runs = sorted(file.parent for file in path.rglob("model.json"))
    if not runs:
        raise FileNotFoundError(f"run={path} holds no model.json; is it the folder of a run?")
    return runs


def existing_history(store: str | None) -> History:
    """Return a history, to be closed; ValueError without a name, HistoryError if it is missing."""
    if not store:
        raise ValueError("which history? Give store=FILE, or store=postgresql://...")
    check_exists(store)
    return History(store)


def write_maintenance(history: History, folder: Path, settings: BoardSettings) -> list[State]:
    """Write overview, plan and calendar of all suspensions of a history, and store their alarms.

    Returns the states, the worst first. HistoryError if the store cannot be used; ValueError if it
    is empty.
    """
    fleet = [series.relative_to_first(settings.n_first) for series in history.series()]
    if not fleet:
        raise ValueError(f"{history}: no trip is stored here yet")
    own = {series.vehicle: settings.limits_of(series.vehicle) for series in fleet}
    states = fleet_state(fleet, own, settings.changes, settings.sisters, settings.seed)
    history.keep_all_alarms({state.key: state.watched.alarms for state in states})
    acknowledged = history.all_acknowledgements()
    planned = plan_of(states, settings.plan, settings.day())
    view = fleet_view(states, own, acknowledged, planned)
    write_fleet(view, planned, plan_calendar(planned), folder)
    counts = Counter(str(state.severity) for state in states)
    write_json(
        folder / "metrics.json",
        {
            "severities": counts,
            "n_visits": len(planned.visits),
            "n_jobs": sum(len(visit.jobs) for visit in planned.visits),
            "n_waiting": len(planned.waiting),
            "n_unknown": len(planned.unknown),
        },
    )
    log.info("%s\n\n%s\n-> %s", overview_table(view.rows), planned, folder)
    return states
