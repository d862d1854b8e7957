"""The figures of a run, in its folder and in TensorBoard."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.problem import TEST, Problem
from suspnet.learning.search import SearchResult
from suspnet.report.tensorboard import RunLog
from suspnet.runs import plots
from suspnet.runs.predict import Outcome


def draw_run(
    problem: Problem,
    model: FittedMethod,
    outcome: Outcome,
    run_log: RunLog,
    folder: Path,
    found: SearchResult | None,
    draw_vehicle: bool,
) -> None:
    """Draw features, search and predictions of a run, and its vehicle if asked."""
    task = model.task
    frequencies_hz = problem.observer.frequencies_hz
    example = problem.curves(outcome.data.ratios[:1], TEST, 0)
    data = outcome.data
    figures = {
        "features": plots.feature_spread(data.inputs, task.inputs, data.outputs, task.outputs)
    }
    if draw_vehicle:
        figures["bode"] = plots.bode(problem.generator, frequencies_hz)
        figures["degradation"] = plots.degradation(problem.generator, frequencies_hz)
    if task.extractor.kind == "peaks":
        table = task.extractor.extract(example, frequencies_hz.to(example.device))
        features = dict(zip(task.extractor.names, table.values[0].tolist(), strict=True))
        figures["peaks"] = plots.peak_fits(
            frequencies_hz.numpy(), example[0].abs().cpu().numpy(), features
        )
    objectives = getattr(model.estimator, "objectives_", [])
    if len(objectives) > 2:
        figures["convergence"] = plots.convergence(objectives)
    if found is not None:
        numbers = [
            {k: v for k, v in setting.items() if isinstance(v, int | float)}
            for setting in found.settings
        ]
        figures["search"] = plots.search_map(numbers, found.rmse)
    _write_figures(figures, _title(problem, model.name), run_log, folder)
    draw_predictions(problem, model.name, outcome, run_log, folder)


def draw_predictions(
    problem: Problem, name: str, outcome: Outcome, run_log: RunLog, folder: Path
) -> None:
    """Draw estimates against truth, and residuals."""
    arrays = outcome.data.outputs, outcome.predicted, problem.task.outputs
    figures = {"parity": plots.parity(*arrays), "residuals": plots.residuals(*arrays)}
    _write_figures(figures, _title(problem, name), run_log, folder)


def _write_figures(
    figures: Mapping[str, Figure], title: str, run_log: RunLog, folder: Path
) -> None:
    """Write figures with a common title to the folder and TensorBoard."""
    for name, figure in figures.items():
        figure.suptitle(title, fontsize="small")
        run_log.figure(name, figure, folder)


def _title(problem: Problem, name: str) -> str:
    """Return the title of a run's figures."""
    task = problem.task
    noise = f"{problem.settings.snr_db:g} dB, seed {problem.seed}"
    return f"{problem.vehicle.name}, protocol {task.protocol}, group {task.group}, {name}, {noise}"
