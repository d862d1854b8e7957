"""Score a trained model on fresh curves."""

from dataclasses import dataclass, replace
from pathlib import Path

from suspnet.curves.problem import TEST, Problem
from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.rig_files import RIG_FILE
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.progress import stage
from suspnet.ground.storage import write_json
from suspnet.runs.predict import predict_stream
from suspnet.runs.scores import Metrics, draw_run, headline, log_scores, report, rms_percent, scores
from suspnet.runs.tensorboard import RunLog


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
    if not isinstance(model, TrainedModel):
        raise ValueError(
            f"{folder} holds a commissioned bogie, which curves do not test: give trips=DIR"
        )
    problem = fresh.problem(model, folder)
    stage(f"test of {folder}")
    outcome = predict_stream(problem, model, TEST, flags=True)
    metrics = {
        **headline(problem, model),
        **scores(problem, model, outcome),
        "seconds": outcome.seconds,
        "run": str(folder),
        "rms_percent": rms_percent(problem.task, outcome),
    }
    with RunLog(output, is_new=True) as run_log:
        # the models of a multirun may have different outputs
        log_scores(run_log, metrics, model.training["parameters"], ("model", "group"))
        if figures:
            draw_run(problem, model, outcome, run_log, output / "figures")
    write_json(output / "metrics.json", metrics)
    report(metrics, output)
    return metrics


def find_runs(path: Path) -> list[Path]:
    """Return the folders with a model at or below `path`: one run, or all of a multirun.

    FileNotFoundError if there is none, ValueError if it is that of a rig.
    """
    if not path.exists():
        raise FileNotFoundError(f"run={path} does not exist")
    runs = sorted(file.parent for file in path.rglob("model.json"))
    if not runs and (path / RIG_FILE).is_file():
        raise ValueError(f"run={path} holds a rig: evaluate with trips=DIR alone reads its records")
    if not runs:
        raise FileNotFoundError(f"run={path} holds no model.json; is it the folder of a run?")
    return runs
