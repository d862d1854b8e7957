"""All trips of a folder: evaluated in parallel, written as tables, figures and a report."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
from joblib import Parallel, delayed, parallel_config
from tabulate import tabulate
from tqdm import tqdm

import suspnet
from suspnet.checkpoint import ModelFileError, TrainedModel
from suspnet.data.estimates import EstimateSettings
from suspnet.data.manifest import find_manifests
from suspnet.data.source import quiet
from suspnet.data.storage import write_atomically, write_json
from suspnet.monitoring import figures
from suspnet.monitoring.records import OK, TripResult, relative_to_first
from suspnet.monitoring.report import write_report
from suspnet.monitoring.trend import LEAST_PERCENT, Trend, trend
from suspnet.monitoring.trip import TripSettings, evaluate_trip
from suspnet.tracking import RunLog

try:
    from distributed import Client
except ImportError:  # the extra `cluster` is not installed
    Client = None

log = logging.getLogger(__name__)
KNOWN_ERROR_PERCENT = "rms error %"
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
        if self.cluster is not None and Client is None:
            raise ValueError('`cluster` needs dask: pip install "suspnet[cluster]"')


def check_models(models: Sequence[TrainedModel]) -> tuple[str, ...]:
    """Return the outputs of models that can read trips together.

    Raises
    ------
    ModelFileError
        If one was not trained on estimates from trips, needs a measured mass, or they differ in
        vehicle or outputs.
    """
    for model in models:
        if not isinstance(model.settings, EstimateSettings):
            raise ModelFileError(
                f"the model of protocol {model.task.protocol!r} was trained on curves of section "
                "III-B; trips need one of: python train.py experiment=trips"
            )
        if model.task.mass_known:
            raise ModelFileError("models with protocol.mass_known=true cannot read trips")
    first = models[0]
    for model in models[1:]:
        if (model.vehicle, model.task.outputs) != (first.vehicle, first.task.outputs):
            raise ModelFileError(
                "the models of one run must share vehicle and outputs; give the folder of one run"
            )
    return first.task.outputs


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
    _write_tables(results, outputs, output)
    trends = _trends(results, outputs, models)
    _write_pages(results, outputs, trends, output, _details(folder, models, settings))
    log.info("%s\n-> %s", summary(results, outputs), output)
    return results


def summary(results: Sequence[TripResult], outputs: Sequence[str]) -> str:
    """Return a table of all trips, and the errors where the truth is known."""
    header = ["trip", "1000 km", *outputs, "averages", "reason"]
    rows = [
        [
            r.trip,
            r.mileage_km / 1000,
            *(r.estimates.get(name) for name in outputs),
            r.quality.n_averages,
            r.reason,
        ]
        for r in results
    ]
    errors = errors_percent(results, outputs)
    if errors:
        rows.append([KNOWN_ERROR_PERCENT, None, *(errors[name] for name in outputs), None, None])
    table = tabulate(rows, header, tablefmt="github", floatfmt=("", ".1f", *[".4g"] * 20))
    done = sum(r.status == OK for r in results)
    return f"{done} of {len(results)} trips have an estimate\n{table}"


def errors_percent(results: Sequence[TripResult], outputs: Sequence[str]) -> dict[str, float]:
    """Return the rms relative error of each output over trips whose truth is known, [%]."""
    known = [r for r in results if r.status == OK and all(name in r.truth for name in outputs)]
    if not known:
        return {}
    return {
        name: 100
        * float(np.sqrt(np.mean([(r.estimates[name] / r.truth[name] - 1) ** 2 for r in known])))
        for name in outputs
    }


def _evaluated(
    paths: Sequence[Path],
    models: Sequence[TrainedModel],
    settings: FleetSettings,
    progress: bool,
) -> list[TripResult]:
    jobs = [delayed(evaluate_trip)(path.absolute(), models, settings.trips) for path in paths]
    bar = tqdm(total=len(paths), desc="trips", unit="trip", disable=quiet(progress))
    with bar, _backend(settings):
        results = []
        for result in Parallel(return_as="generator_unordered")(jobs):
            results.append(result)
            bar.update()
    return results


def _backend(settings: FleetSettings) -> Any:
    if settings.cluster is None:
        return parallel_config(n_jobs=settings.workers, inner_max_num_threads=None)
    address = None if settings.cluster == "local" else settings.cluster
    client = Client(address, **({} if address else {"n_workers": settings.workers}))
    return parallel_config("dask", client=client, n_jobs=-1)


def _write_tables(results: Sequence[TripResult], outputs: tuple[str, ...], output: Path) -> None:
    table = pa.Table.from_pylist([result.row(outputs) for result in results])
    for name, write in (("trips.parquet", pq.write_table), ("trips.csv", pacsv.write_csv)):
        stream = io.BytesIO()
        write(table, stream)
        write_atomically(output / name, stream.getvalue())
    curves = [
        pa.table(
            {
                "trip": [result.trip] * len(result.curves.frequencies_hz),
                "frequency_hz": result.curves.frequencies_hz,
                **{
                    f"{what}_{link}": values[i]
                    for i, link in enumerate(("p", "s"))
                    for what, values in (
                        ("magnitude", np.abs(result.curves.responses)),
                        ("phase_rad", np.angle(result.curves.responses)),
                        ("coherence", result.curves.coherences),
                        ("deviation", result.curves.deviations),
                    )
                },
            }
        )
        for result in results
        if result.curves is not None
    ]
    if curves:
        stream = io.BytesIO()
        pq.write_table(pa.concat_tables(curves), stream)
        write_atomically(output / "responses.parquet", stream.getvalue())


def _trends(
    results: Sequence[TripResult], outputs: tuple[str, ...], models: Sequence[TrainedModel]
) -> list[Trend]:
    """Return each parameter's trend; what the models cannot resolve does not stand out."""
    mileage = np.array([r.mileage_km for r in results])
    trends = []
    for name in outputs:
        rms = max(m.training.get("test_rms_percent", {}).get(name, 0.0) for m in models)
        least = max(LEAST_PERCENT, RESOLVED * rms)
        values = np.array([r.estimates.get(name, np.nan) for r in results])
        trends.append(trend(name, mileage, values, least_percent=least))
    return trends


def _write_pages(
    results: Sequence[TripResult],
    outputs: tuple[str, ...],
    trends: Sequence[Trend],
    output: Path,
    details: Mapping[str, str],
) -> None:
    done = [r for r in results if r.status == OK]
    drawn = {
        "trend": figures.health_trend(results, outputs),
        "responses": figures.trip_responses(results),
        "signals": figures.trip_signals(done[-1] if done else results[-1]),
        "quality": figures.quality(results),
    }
    with RunLog(output) as run_log:
        for i, result in enumerate(done):
            values = result.estimates | {"n_averages": result.quality.n_averages}
            step = i if np.isnan(result.mileage_km) else round(result.mileage_km)
            run_log.scalars("trips", values, step)
        for name, figure in drawn.items():
            run_log.figure(name, figure, output / "figures")
        run_log.text("trips", summary(results, outputs))
    errors = errors_percent(results, outputs)
    metrics = {
        "n_trips": len(results),
        "n_estimated": len(done),
        "rms_error_percent": errors,
        "trends": [asdict(one) for one in trends],
        "details": dict(details),
    }
    write_json(output / "metrics.json", json.loads(json.dumps(metrics, default=float)))
    write_report(
        output / "report.html", "Suspension report", results, outputs, drawn, trends, details
    )


def _details(
    folder: Path, models: Sequence[TrainedModel], settings: FleetSettings
) -> dict[str, str]:
    first = models[0]
    assert isinstance(first.settings, EstimateSettings)
    reference = (
        "the vehicle's parameters"
        if settings.reference == "vehicle"
        else f"the median of the first {settings.n_reference} trips (k and c)"
    )
    return {
        "trips": str(folder),
        "suspnet": suspnet.__version__,
        "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        "model": f"{first.name}, trained on {first.training.get('n_train', 0)} curves of "
        f"{type(first.generator).__name__}",
        "speeds": ", ".join(f"{_speed(m):g} m/s" for m in models),
        "transfer functions": f"{first.settings.method}, {first.settings.window} windows of "
        f"{first.settings.segment_s:g} s",
        "healthy is": reference,
    }


def _speed(model: TrainedModel) -> float:
    assert isinstance(model.settings, EstimateSettings)
    return model.settings.speed_m_per_s
