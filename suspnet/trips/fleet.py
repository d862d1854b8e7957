"""All trips of a folder: evaluated in parallel, written as tables, figures and a report."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np
from joblib import Parallel, delayed, parallel_config
from tqdm import tqdm

import suspnet
from suspnet.model import ModelFileError, TrainedModel
from suspnet.model.recording import TripSettings
from suspnet.model.spectra import trip_observer
from suspnet.data.parallel import quiet
from suspnet.trips.output import summary, write_pages, write_tables
from suspnet.trips.records import TripResult, first_trips, relative_to_first
from suspnet.trips.trend import LEAST_PERCENT, Trend, flagged_trend
from suspnet.trips.trip import evaluate_trip
from suspnet.recordings.manifest import find_manifests

try:
    import distributed
except ImportError:
    HAS_DASK = False
else:
    HAS_DASK = True

log = logging.getLogger(__name__)
RESOLVED = 2.0
"""A change must exceed this multiple of the model's rms error on its test curves."""


@dataclass(frozen=True)
class FleetSettings:
    """How a folder of trips is evaluated.

    Parameters
    ----------
    trips : TripSettings
    reference : {"vehicle", "first_trips"}
        Healthy is what the vehicle's parameters say, or what its first trips show.
    n_reference : int
        Number of first trips.
    workers : int
        Local processes.
    cluster : str, optional
        Address of a dask scheduler, e.g. tcp://host:8786, or "local" for one on this machine;
        None uses local processes.

    Raises
    ------
    ValueError
        If a setting is out of range, or dask is asked for and not installed.
    """

    trips: TripSettings
    reference: Literal["vehicle", "first_trips"] = "vehicle"
    n_reference: int = 5
    workers: int = 1
    cluster: str | None = None

    def __post_init__(self) -> None:
        if self.reference not in ("vehicle", "first_trips"):
            raise ValueError(
                f"`reference` must be 'vehicle' or 'first_trips', got {self.reference!r}"
            )
        for name in ("n_reference", "workers"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"`{name}` must be a whole number >= 1, got {value!r}")
        if self.cluster is not None and not HAS_DASK:
            raise ValueError('`cluster` needs dask: pip install "suspnet[cluster]"')


def check_models(models: Sequence[TrainedModel]) -> tuple[str, ...]:
    """Return the outputs of models that can read trips together.

    Raises
    ------
    ModelFileError
        If one was not trained on estimates from trips, needs a measured mass, or if they differ
        in vehicle or outputs or share a speed.
    """
    for model in models:
        trip_observer(model)
        if model.task.mass_known:
            raise ModelFileError("models with protocol.mass_known=true cannot read trips")
    first = models[0]
    for model in models[1:]:
        if (model.vehicle, model.task.outputs) != (first.vehicle, first.task.outputs):
            raise ModelFileError(
                "the models of one run must share vehicle and outputs; give the folder of one run"
            )
    speeds = [model.generator.speed_m_per_s for model in models]
    if len(set(speeds)) < len(speeds):
        raise ModelFileError(
            f"two models are for the same speed ({', '.join(map(_speed_words, speeds))}); give the "
            "folder of one run, or of a multirun over speed_m_per_s alone"
        )
    return first.task.outputs


def _speed_words(speed: float | None) -> str:
    return "any" if speed is None else f"{speed:g} m/s"


def evaluate_fleet(
    folder: Path,
    models: Sequence[TrainedModel],
    output: Path,
    settings: FleetSettings,
    progress: bool = True,
) -> list[TripResult]:
    """Evaluate every trip of a folder and write trips.parquet, .csv, figures and report.html.

    Parameters
    ----------
    folder : Path
        Holds a manifest for each trip.
    models : sequence of TrainedModel
        One for each speed bin.
    output : Path
    settings : FleetSettings
    progress : bool

    Returns
    -------
    list of TripResult
        Ascending mileage.

    Raises
    ------
    FileNotFoundError
        If the folder holds no manifest.
    ModelFileError
        If a model cannot read trips.
    ValueError
        If too few trips can serve as reference.
    """
    outputs = check_models(models)
    paths = find_manifests(folder)
    results = _evaluated(paths, models, settings, progress)
    results.sort(key=lambda r: (np.isnan(r.mileage_km), r.mileage_km, r.trip))
    if settings.reference == "first_trips":
        results = relative_to_first(results, settings.n_reference)
    suspensions = sorted({r.suspension for r in results if r.suspension})
    if len(suspensions) > 1:
        log.warning(
            "%s holds trips of %d suspensions (%s): their trend is one line only if they are one; "
            "give each a folder of its own",
            folder,
            len(suspensions),
            "; ".join(suspensions),
        )
    write_tables(results, outputs, output)
    trends = _trends(results, outputs, models)
    details = _details(folder, models, settings, results)
    write_pages(results, outputs, trends, output, details, settings.trips.level)
    log.info("%s\n-> %s", summary(results, outputs), output)
    return results


def _evaluated(
    paths: Sequence[Path],
    models: Sequence[TrainedModel],
    settings: FleetSettings,
    progress: bool,
) -> list[TripResult]:
    jobs = [delayed(evaluate_trip)(path.absolute(), models, settings.trips) for path in paths]
    bar = tqdm(total=len(paths), desc="trips", unit="trip", disable=quiet(progress))
    with bar, _backend(settings), warnings.catch_warnings():
        # joblib replaces a worker whose memory has grown; no trip is lost
        warnings.filterwarnings("ignore", "A worker stopped while", UserWarning)
        results = []
        for result in Parallel(return_as="generator_unordered")(jobs):
            results.append(result)
            bar.update()
    return results


@contextmanager
def _backend(settings: FleetSettings) -> Iterator[None]:
    """Say where the trips are evaluated: in local processes or on a dask cluster."""
    if settings.cluster is None:
        with parallel_config(n_jobs=settings.workers):
            yield
        return
    address = None if settings.cluster == "local" else settings.cluster
    options = {} if address else {"n_workers": settings.workers, "dashboard_address": None}
    with distributed.Client(address, **options) as client:
        with parallel_config("dask", client=client, n_jobs=-1):
            yield


def _trends(
    results: Sequence[TripResult], outputs: tuple[str, ...], models: Sequence[TrainedModel]
) -> list[Trend]:
    """Return each parameter's trend; what the models cannot resolve does not stand out."""
    mileage = np.array([r.mileage_km for r in results])
    flagged = np.array([bool(r.flags) for r in results])
    trends = []
    for name in outputs:
        rms = max(m.training.get("test_rms_percent", {}).get(name, 0.0) for m in models)
        least = max(LEAST_PERCENT, RESOLVED * rms)
        values = np.array([r.estimates.get(name, np.nan) for r in results])
        trends.append(flagged_trend(name, mileage, values, flagged, least_percent=least))
    return trends


def _details(
    folder: Path,
    models: Sequence[TrainedModel],
    settings: FleetSettings,
    results: list[TripResult],
) -> dict[str, str]:
    first = models[0]
    trained = trip_observer(first).settings
    reference = "the vehicle's parameters"
    if settings.reference == "first_trips":
        reference = f"the median of the first {settings.n_reference} trips (k and c)"
        flagged = sum(bool(r.flags) for r in first_trips(results, settings.n_reference))
        if flagged:
            reference += f", {flagged} of them flagged"
    return {
        "trips": str(folder),
        "suspnet": suspnet.__version__,
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "model": f"{first.name}, trained on {first.training.get('n_train', 0)} curves of "
        f"{type(first.generator).__name__}",
        "speeds": ", ".join(_speed_words(m.generator.speed_m_per_s) for m in models),
        "transfer functions": f"{trained.method}, {trained.window} windows of "
        f"{trained.segment_s:g} s",
        "healthy is": reference,
        "intervals": _interval_words(first, settings.trips.level),
    }


def _interval_words(model: TrainedModel, level: float) -> str:
    if model.intervals is None:
        return "none: the model was trained with data.n_calibrate=null"
    return (
        f"{100 * level:g} %, calibrated on {len(model.intervals.conformal.scores)} simulated "
        "curves that the model was not trained on, then adapted to the noise of each trip"
    )
