"""All trips of a folder: evaluated in parallel, one report for each suspension."""

from __future__ import annotations

import functools
import logging
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from suspnet.estimation.from_recording import TripSettings
from suspnet.estimation.from_spectra import trip_settings
from suspnet.estimation.trained import TrainedModel
from suspnet.ground.parameters import PARAMETERS, TIGHTEST
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.progress import stage
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.storage import printable
from suspnet.ground.workers import LostWorkerError, each
from suspnet.history import Event, History, Series
from suspnet.history.records import ERROR, TripResult, relative_to_first
from suspnet.maintenance.alarms import OWN_CAUSES, Acknowledgement
from suspnet.maintenance.assessment import Assessment, assess, last_trips, spoken
from suspnet.maintenance.change import ChangeSettings
from suspnet.maintenance.fleet_lives import (
    Wear,
    learn_wear,
    lives_of,
    present,
    series_of,
    unknown_lives,
)
from suspnet.maintenance.limits import Limits, Severity, read_limits
from suspnet.maintenance.trend import LEAST_PERCENT, flagged_trend
from suspnet.maintenance.watch import Watched, detector_words
from suspnet.maintenance.watching import watch_trips
from suspnet.recordings.manifest_files import partial_words, read_manifest
from suspnet.report.output import summary, write_pages, write_tables
from suspnet.report.overview import Evaluated, write_overview
from suspnet.trips.commissionings import (
    Commissioning,
    check_one_reference,
    commissionings,
    eras,
    of_last_era,
    with_truth_of_each,
)
from suspnet.trips.details import UNKNOWN_HEALTHY, missing_reference, report_details
from suspnet.trips.earlier import between, with_earlier
from suspnet.trips.grouping import Group, find_groups
from suspnet.trips.models import models_of
from suspnet.trips.result_cache import FinishedTrips
from suspnet.trips.trip import evaluate_trip, lost_trip

try:
    import distributed
except ImportError:
    HAS_DASK = False
else:
    HAS_DASK = True

log = logging.getLogger(__name__)
RESOLVED = 2.0
"""A change must exceed this multiple of the model's rms error on its test curves."""
OVERRIDDEN = "set for this evaluation"
"""Reason of limits that are given as a setting without one."""


@dataclass(frozen=True)
class FleetSettings:
    """How a folder of trips is evaluated.

    Parameters
    ----------
    trips : TripSettings
    limits : mapping, optional
        In place of the vehicle's: from a parameter to its `notice` and `act`, each [lower, upper]
        relative to healthy, and `why`. What is not there or None is as the vehicle's; a parameter
        that is None raises no alarm.
    changes : ChangeSettings
        How changes are looked for.

    Raises
    ------
    ValueError
        If a setting is out of range, or dask is asked for and not installed.
    """

    trips: TripSettings
    reference: Literal["vehicle", "first_trips"] = setting(
        "vehicle",
        "What counts as healthy: the parameters of the vehicle, or what its first trips show",
    )
    n_reference: int = setting(
        5, "Number of first trips, for reference=first_trips", low=1, most=1024
    )
    workers: int = setting(
        1, "Number of processes on this machine that read trips", low=1, most=1024
    )
    cluster: str | None = setting(
        None,
        "Address of a dask scheduler that reads trips instead, tcp://host:8786, or local; null "
        "is none",
        rule="text",
    )
    limits: Mapping[str, Any] | None = None
    changes: ChangeSettings = field(default_factory=ChangeSettings)

    def __post_init__(self) -> None:
        check_settings(self)
        any_limits = dict.fromkeys(PARAMETERS, TIGHTEST)
        read_limits(self.limits or {}, any_limits)  # whatever the vehicle's are
        if self.cluster is not None and not HAS_DASK:
            raise ValueError('`cluster` needs dask: pip install "suspnet[cluster]"')

    @property
    def n_first(self) -> int | None:
        """Number of first trips that say what healthy is; None: the models do."""
        return self.n_reference if self.reference == "first_trips" else None

    def limits_of(self, models: Sequence[TrainedModel]) -> dict[str, Limits]:
        """Return the limits of each parameter that has any: these, or the vehicle's.

        Of models of several commissionings, those of the last one count.

        Raises
        ------
        ValueError
            If these and those do not go together.
        """
        vehicle = eras(models)[-1][0].vehicle
        return read_limits(self.limits or {}, vehicle.known_limits, OVERRIDDEN)


def evaluate_fleet(
    folder: Path,
    models: Sequence[TrainedModel],
    output: Path,
    settings: FleetSettings,
    progress: bool = True,
    store: History | None = None,
    seed: int = 0,
    figures: bool = True,
) -> list[Evaluated]:
    """Evaluate every trip of a folder; write tables, figures and a report for each suspension.

    If the folder holds the trips of one suspension, its files lie in `output`. If it holds those
    of several, or subfolders with trips, each suspension has a subfolder of `output`, and
    overview.html, .csv and .parquet there name the worst first. A suspension that cannot be read is
    told in the log and in the overview.

    Parameters
    ----------
    folder : Path
        Holds a manifest for each trip, or subfolders that do.
    models : sequence of TrainedModel
        One for each speed bin, and for each bogie that the manifests name, or those that were
        commissioned on each suspension.
    output : Path
    settings : FleetSettings
    progress : bool
    store : History, optional
        Keeps the trips; those of earlier folders that it holds are in tables, trend and report.
    seed : int
        Of the remaining lives.
    figures : bool
        Whether figures are drawn, in a folder and in the report.

    Returns
    -------
    list of Evaluated
        The most severe first.

    Raises
    ------
    FileNotFoundError
        If the folder holds no manifest.
    ModelFileError
        If a model cannot read trips.
    ValueError
        If no suspension could be read, or the limits do not go together.
    """
    settings.limits_of(models)
    groups = find_groups(folder)
    if len(groups) == 1 and groups[0].folder == folder:
        one = _read_group(groups[0], models, output, settings, progress, store)
        return [_report(one, settings, store, _wear([one], store), seed, figures)]
    for model in models:
        trip_settings(model)
    if partial := partial_words(folder):
        log.warning("%s is %s; the same simulation again writes the others", folder, partial)
    done: list[Evaluated] = []

    def lose(group: Group, error: str) -> None:
        done.append(Evaluated(group.name, group.place, error=error))
        log.warning("%s is not read: %s", group.name, error)

    read = []
    for group in groups:
        if group.error:
            lose(group, group.error)
            continue
        try:
            where = output / group.name
            read.append(_read_group(group, models, where, settings, progress, store))
        except (ValueError, ArithmeticError) as error:
            lose(group, str(error))
    wear = _wear(read, store)  # of all of them, so after the last is read
    for one in read:
        try:
            done.append(_report(one, settings, store, wear, seed, figures))
        except (ValueError, ArithmeticError) as error:
            lose(one.group, str(error))
    if all(one.error for one in done):
        reasons = "; ".join(f"{one.name}: {one.error}" for one in done)
        raise ValueError(f"{folder}: none of its {len(done)} suspensions can be read ({reasons})")
    done.sort(key=lambda one: (-one.severity, one.name))
    log.info("%s\n-> %s", write_overview(done, models[0].task.outputs, output), output)
    return done


@dataclass(frozen=True, eq=False)
class _Read:
    """Trips of one suspension, with those that the store held before, and where they go."""

    group: Group
    models: Sequence[TrainedModel]
    output: Path
    limits: Mapping[str, Limits]
    results: list[TripResult]
    states: list[Commissioning]
    events: list[Event]

    @property
    def outputs(self) -> tuple[str, ...]:
        """The parameters that the models estimate."""
        return self.models[0].task.outputs

    @property
    def vehicle(self) -> str:
        """Name of the vehicle."""
        return self.models[0].vehicle.name

    @cached_property
    def series(self) -> Series:
        """The same trips as arrays."""
        return series_of(self.results, self.events)


def _wear(read: Sequence[_Read], store: History | None) -> Wear:
    """Return how the fleet of a store wears, or without one the suspensions that were just read."""
    if not read:
        return Wear()
    found = [one.series for one in read]
    if store is not None:
        found = [one for one in store.series() if one.vehicle == read[0].vehicle]
    return learn_wear(found, read[0].limits, is_history=store is not None)


def _read_group(
    group: Group,
    models: Sequence[TrainedModel],
    output: Path,
    settings: FleetSettings,
    progress: bool,
    store: History | None,
) -> _Read:
    """Evaluate one suspension's trips, and keep them in the store."""
    fitting = models_of(models, group.place)
    limits = settings.limits_of(fitting)
    if settings.reference == "first_trips":
        check_one_reference(fitting)
    title = f"trips of {group.place}"
    results = [
        replace(result, place=group.place)
        for result in _evaluated(group.manifests, fitting, output, settings, progress, title)
    ]
    events: list[Event] = []
    if store is not None:
        results = with_earlier(results, group.place, fitting, store)
        events = store.events(fitting[0].vehicle.name, group.place)
    results.sort(key=lambda r: (np.isnan(r.mileage_km), r.mileage_km, r.trip))
    if settings.reference == "first_trips":
        parts = between(events, results)
        results = [r for part in parts for r in relative_to_first(part, settings.n_reference)]
    states = commissionings(fitting, results)
    results = with_truth_of_each(results, states)
    return _Read(group, fitting, output, limits, results, states, events)


def _report(
    read: _Read,
    settings: FleetSettings,
    store: History | None,
    wear: Wear,
    seed: int,
    figures: bool,
) -> Evaluated:
    """Write tables, figures and report of one suspension."""
    stage(f"trend and report of {read.group.place}")
    group, results, states, events = read.group, read.results, read.states, read.events
    outputs, limits, output, fitting = read.outputs, read.limits, read.output, read.models
    write_tables(results, outputs, output)
    era = of_last_era(results, states)
    recent = between(events, era)[-1]
    least = _least_percent(outputs, fitting)
    watched = watch_trips(era, events, outputs, limits, settings.changes)
    seen: list[Acknowledgement] = []
    if store is not None and any(r.status != ERROR for r in results):
        store.keep_alarms(read.vehicle, group.place, watched.alarms, OWN_CAUSES)
        seen = store.acknowledgements(read.vehicle, group.place)
    lives = lives_of(read.series, limits, watched.passed, wear.priors, seed)
    unknown = unknown_lives(read.series, [n for n in limits if n not in watched.passed])
    found = [
        replace(
            one,
            now=present(read.series, one.parameter),
            life=lives.get(one.parameter),
            unknown_life=unknown.get(one.parameter, ""),
        )
        for one in _assessments(recent, outputs, least, limits, watched)
    ]
    missing = missing_reference(recent, settings.n_first)
    if missing:
        log.warning("%s: %s", group.folder, missing)
        found = [_without_reference(one) for one in found]
    details = report_details(
        group.folder, fitting, results, limits, settings.trips.level, settings.n_first
    )
    details["remaining lives"] = wear.words
    details["alarms of changes"] = armed = detector_words(watched.changes, settings.changes)
    partial = partial_words(group.folder)
    if partial:
        log.warning("%s is %s; the same simulation again writes the others", group.folder, partial)
        details["trips"] += f" ({partial})"
    if store is not None:
        details["history"] = printable(str(store))
    options = settings.trips.level, limits, states, events, watched.alarms, seen
    write_pages(results, outputs, found, output, details, *options, draw=figures)
    words = f"{spoken(found)}\nAlarms of changes: {armed}."
    log.info("%s\n%s: %s\n-> %s", summary(results, outputs), group.place, words, output)
    return Evaluated(group.name, group.place, results, found)


def _evaluated(
    paths: Sequence[Path],
    models: Sequence[TrainedModel],
    output: Path,
    settings: FleetSettings,
    progress: bool,
    title: str,
) -> list[TripResult]:
    """Return the result of every trip: kept by an earlier evaluation, or read in parallel now."""
    finished = FinishedTrips(output, models, settings.trips)
    results, made_from = [], {}
    bar = progress_bar(title, len(paths), unit="trip", shown=progress)
    with bar, warnings.catch_warnings():
        # a worker whose memory has grown is replaced; no trip is lost
        warnings.filterwarnings("ignore", "A worker stopped while", UserWarning)
        for path in paths:
            path = path.absolute()
            try:
                made_from[path] = finished.made_from(read_manifest(path))
                result = finished.read(made_from[path])
            except Exception:  # `evaluate_trip` says what is wrong, which needs no worker
                result = evaluate_trip(path, models, settings.trips)
            if result is not None:
                made_from.pop(path, None)
                results.append(result)
                bar.update()
        if results and made_from:
            log.info("%d trips are finished already, %d are to be read", bar.n, len(made_from))
        read = functools.partial(evaluate_trip, models=models, settings=settings.trips)
        for path, one in _read_by_workers(read, list(made_from), settings):
            if isinstance(one, LostWorkerError):
                results.append(lost_trip(path, str(one)))
            else:
                results.append(one)
                finished.write(made_from[path], one)
            bar.update()
    return results


def _read_by_workers(
    read: Callable[[Path], TripResult], paths: Sequence[Path], settings: FleetSettings
) -> Iterator[tuple[Path, TripResult | LostWorkerError]]:
    """Yield trips with their results as they are read, in local processes or on a dask cluster."""
    if settings.cluster is None:
        yield from each(read, paths, settings.workers)
        return
    address = None if settings.cluster == "local" else settings.cluster
    options = {} if address else {"n_workers": settings.workers, "dashboard_address": None}
    with distributed.Client(address, **options) as client:
        trips = {client.submit(read, path, pure=False, retries=1): path for path in paths}
        for future in distributed.as_completed(trips):
            try:
                yield trips[future], future.result()
            except distributed.KilledWorker as error:
                yield trips[future], LostWorkerError(str(error))


def _least_percent(outputs: Sequence[str], models: Sequence[TrainedModel]) -> dict[str, float]:
    """Return the smallest change of each parameter, in %, that the models can resolve."""
    rms = {
        name: max(m.training.get("test_rms_percent", {}).get(name, 0.0) for m in models)
        for name in outputs
    }
    return {name: max(LEAST_PERCENT, RESOLVED * one) for name, one in rms.items()}


def _assessments(
    results: Sequence[TripResult],
    outputs: tuple[str, ...],
    least_percent: Mapping[str, float],
    limits: Mapping[str, Limits],
    watched: Watched,
) -> list[Assessment]:
    """Return each parameter's assessment; a change that the models cannot resolve is none."""
    mileage = np.array([r.mileage_km for r in results])
    flagged = np.array([bool(r.flags) for r in results])
    estimates = {name: [r.estimates.get(name, np.nan) for r in results] for name in outputs}
    found = []
    for name in outputs:
        values = np.array(estimates[name])
        trend = flagged_trend(name, mileage, values, flagged, least_percent=least_percent[name])
        last = last_trips(mileage, values, [r.interval(name) for r in results], flagged)
        found.append(assess(trend, last, limits.get(name), watched.standing(name)))
    return found


def _without_reference(one: Assessment) -> Assessment:
    """Return an assessment where healthy is not known: the parameter cannot be judged, at least."""
    if not one.limited:
        return one
    severity = max(one.severity, Severity.UNKNOWN)
    return replace(one, severity=severity, words=f"{UNKNOWN_HEALTHY}; {one.words}")
