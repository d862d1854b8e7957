"""All trips of a folder: evaluated in parallel, one report for each suspension."""

import functools
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from suspnet.estimation.fitted import Model
from suspnet.estimation.from_spectra import trip_settings
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import at, of, together
from suspnet.ground.parameters import ESTIMATED, TIGHTEST, Limits, read_limits
from suspnet.ground.progress import bar as progress_bar
from suspnet.ground.progress import stage
from suspnet.ground.records import ERROR, TripResult, by_mileage, outputs_of
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.storage import printable
from suspnet.ground.workers import ITEMS_A_WORKER, USUAL_WORKERS, LostWorkerError, each, workers_for
from suspnet.runs.language import N_
from suspnet.trains.history import History
from suspnet.trains.history.schema import trip_key
from suspnet.trains.maintenance.alarms import Acknowledgement, detector_words
from suspnet.trains.maintenance.assessment import spoken
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.maintenance.series import Event, series_of, with_widened
from suspnet.trains.maintenance.state import state_of
from suspnet.trains.pages.details import report_details
from suspnet.trains.pages.output import (
    sensor_lines,
    summary,
    write_overview,
    write_pages,
    write_tables,
)
from suspnet.trains.pages.overview import Evaluated
from suspnet.trains.pages.report import Report
from suspnet.trains.recordings.manifest_files import ManifestFile
from suspnet.trains.trips.commissionings import commissionings, eras, models_of, with_truth_of_each
from suspnet.trains.trips.earlier import FinishedTrips, with_earlier
from suspnet.trains.trips.grouping import Group, find_groups
from suspnet.trains.trips.joint_verdicts import with_joint_verdicts
from suspnet.trains.trips.trip import evaluate_trip, lost_trip

log = logging.getLogger(__name__)
OVERRIDDEN = "set for this evaluation"
"""Reason for limits that a setting overrides without giving one."""


@dataclass(frozen=True)
class FleetSettings:
    """How a folder of trips is evaluated.

    `limits` override the vehicle's: from a parameter to its `notice` and `act`, each [lower, upper]
    relative to healthy, and `why`. A missing or None entry leaves the vehicle's value; a parameter
    that is None raises no alarm.
    """

    trips: TripSettings
    workers: int | None = setting(
        1,
        "Number of processes on this machine that read trips; null is 1 for up to "
        f"{ITEMS_A_WORKER} trips, else {USUAL_WORKERS}",
        low=1,
        most=1024,
    )
    limits: Mapping[str, Any] | None = None
    changes: ChangeSettings = field(default_factory=ChangeSettings)

    def __post_init__(self) -> None:
        check_settings(self)
        # check these limits, whatever the vehicle's are
        read_limits(self.limits or {}, dict.fromkeys(ESTIMATED, TIGHTEST))

    def limits_of(self, models: Sequence[Model]) -> dict[str, Limits]:
        """Return the limits of each parameter that has any: overridden, or the vehicle's.

        Of models of several commissionings the last one's vehicle counts. ValueError is raised if
        the limits are inconsistent.
        """
        vehicle = eras(models)[-1][0].vehicle
        return read_limits(self.limits or {}, vehicle.known_limits, OVERRIDDEN)


def evaluate_fleet(
    folder: Path,
    models: Sequence[Model],
    output: Path,
    settings: FleetSettings,
    progress: bool = True,
    store: History | None = None,
    seed: int = 0,
    figures: bool = True,
) -> list[Evaluated]:
    """Evaluate every trip of a folder; write tables, figures and a report for each suspension.

    If the folder holds the trips of one suspension, its files are written to `output`. If it holds
    those of several, or subfolders with trips, each suspension has a subfolder of `output`, and
    overview.html, .csv and .parquet there list the suspensions, the worst first. A suspension that
    cannot be read is named in the log and in the overview.

    `models` has one for each speed bin, and for each bogie that the manifests name, or those
    commissioned on each suspension. `store` saves the trips, and adds those of earlier folders to
    tables, trend and report. `seed` is that of the remaining lives. The most severe suspension is
    returned first.

    FileNotFoundError is raised if the folder holds no manifest, ModelFileError if a model cannot
    read trips, ValueError if no suspension could be read or the limits are inconsistent.
    """
    settings.limits_of(models)  # raises before any trip is read
    groups = find_groups(folder)
    is_alone = len(groups) == 1 and groups[0].folder == folder
    if not is_alone:
        for model in models:
            trip_settings(model)
    done: list[Evaluated] = []
    suspensions = []
    for group in groups:
        with _reported(group, done, is_alone):
            if group.error:
                raise ValueError(group.error)
            where = output if is_alone else output / group.name
            suspensions.append(_suspension(group, models, where, settings))
    for suspension in _evaluated(suspensions, settings, progress):
        with _reported(suspension.group, done, is_alone):
            done.append(_report(suspension, settings, store, seed, figures))
    if is_alone:
        return done
    if all(result.error for result in done):
        reasons = together(of(result.name, result.error) for result in done)
        raise ValueError(at(folder, "no-suspension-read", n_done=len(done), reasons=reasons))
    done.sort(key=lambda result: (-result.severity, result.name))
    log.info("%s\n-> %s", write_overview(done, output), output)
    return done


@contextmanager
def _reported(group: Group, done: list[Evaluated], is_alone: bool) -> Iterator[None]:
    """Record a suspension that cannot be read and log why; raise if it is the only one."""
    try:
        yield
    except (ValueError, ArithmeticError) as error:
        if is_alone:
            raise
        done.append(Evaluated(group.name, group.place, error=str(error)))
        log.warning("%s is not read: %s", group.name, error)


@dataclass(frozen=True, eq=False)
class _Suspension:
    """A suspension with its models and its output folder.

    `results` are those of trips that are read, `waiting` the others with what they are made from.
    """

    group: Group
    models: Sequence[Model]
    output: Path
    limits: Mapping[str, Limits]
    finished: FinishedTrips
    results: list[TripResult] = field(default_factory=list)
    waiting: dict[ManifestFile, Any] = field(default_factory=dict)

    @property
    def vehicle(self) -> str:
        return self.models[0].vehicle.name


def _suspension(
    group: Group, models: Sequence[Model], output: Path, settings: FleetSettings
) -> _Suspension:
    """Return a suspension with the results of those of its trips that need not be read again."""
    fitting = models_of(models, group.place)
    limits = settings.limits_of(fitting)
    finished = FinishedTrips(output, fitting, settings.trips)
    suspension = _Suspension(group, fitting, output, limits, finished)
    for file in [manifest.absolute() for manifest in group.manifests]:
        try:
            made_from = finished.made_from(file)
            result = finished.read(made_from)
        except Exception:  # `evaluate_trip` then reports the fault, without a worker
            suspension.results.append(evaluate_trip(file, fitting, settings.trips))
        else:
            if result is None:
                suspension.waiting[file] = made_from
            else:
                suspension.results.append(result)
    return suspension


def _report(
    suspension: _Suspension,
    settings: FleetSettings,
    store: History | None,
    seed: int,
    figures: bool,
) -> Evaluated:
    """Store the trips of a suspension that are all read, and write its tables and report.

    Returns its state for the overview.
    """
    group, models, output = suspension.group, suspension.models, suspension.output
    stage(f"trend and report of {group.place}")
    # all trips, with those that the store held already
    results = [replace(result, place=group.place) for result in suspension.results]
    events: list[Event] = []
    if store is not None:
        results = with_earlier(results, group.place, models, store)
        events = store.events(suspension.vehicle, group.place)
    alone = by_mileage(results)
    results = with_joint_verdicts(alone, models, settings.trips.level)
    if store is not None:
        # stored before alone; those that the store held already keep what they name
        of_folder = {trip_key(result) for result in suspension.results}
        pairs = zip(results, alone, strict=True)
        store.write([r for r, one in pairs if r is not one and trip_key(r) in of_folder])
    series = replace(series_of(results, events), vehicle=suspension.vehicle)
    results = with_widened(results, events)
    used = commissionings(models, results)
    results = with_truth_of_each(results, used)
    outputs, level = outputs_of(results), settings.trips.level
    # tables come first: what follows may fail on odd numbers
    write_tables(results, outputs, output)
    state = state_of(series, suspension.limits, settings.changes, seed)
    alarms = state.watched.alarms
    seen: list[Acknowledgement] = []
    if store is not None and any(r.status != ERROR for r in results):
        store.keep_alarms(suspension.vehicle, group.place, alarms)
        seen = store.acknowledgements(suspension.vehicle, group.place)
    armed = detector_words(state.watched.changes, settings.changes)
    details = report_details(group.folder, models, results, suspension.limits, level)
    details[N_("alarms of changes")] = armed
    if store is not None:
        details[N_("history")] = printable(str(store))
    report = Report(results, outputs, state, details, level, used, seen)
    write_pages(report, output, draw=figures)
    lines = [spoken(state.assessments), *sensor_lines(results, alarms)]
    words = "\n".join([*lines, f"Alarms of changes: {armed}."])
    page = output / "report.html"
    log.info("%s\n%s: %s\n-> %s", summary(results, outputs), group.place, words, page)
    return Evaluated(group.name, group.place, results, state)


def _evaluated(
    suspensions: Sequence[_Suspension], settings: FleetSettings, progress: bool
) -> Iterator[_Suspension]:
    """Read the trips of all suspensions, and yield each suspension once its trips are read.

    One pool of workers reads all: started for each suspension, it would start over and over, and
    wait for the last trip of each.
    """
    owners = {file: suspension for suspension in suspensions for file in suspension.waiting}
    n_finished = sum(len(suspension.results) for suspension in suspensions)
    n_places = len(suspensions)
    where = f"{suspensions[0].group.place}" if n_places == 1 else f"{n_places} suspensions"
    n_trips = n_finished + len(owners)
    bar = progress_bar(f"trips of {where}", n_trips, unit="trip", shown=progress)
    with bar, warnings.catch_warnings():
        # a worker whose memory has grown is replaced; no trip is lost
        warnings.filterwarnings("ignore", "A worker stopped while", UserWarning)
        bar.update(n_finished)
        if n_finished and owners:
            words = "%d trips are finished already, %d are to be read"
            log.info(words, n_finished, len(owners))
        yield from (suspension for suspension in suspensions if not suspension.waiting)
        items = [(file, suspension.models) for file, suspension in owners.items()]
        read = functools.partial(_read_trip, settings=settings.trips)
        for (file, _), result in each(read, items, workers_for(len(items), settings.workers)):
            suspension = owners[file]
            made_from = suspension.waiting.pop(file)
            if isinstance(result, LostWorkerError):
                suspension.results.append(lost_trip(file.path, str(result)))
            else:
                suspension.results.append(result)
                suspension.finished.write(made_from, result)
            bar.update()
            if not suspension.waiting:
                yield suspension


def _read_trip(item: tuple[ManifestFile, Sequence[Model]], settings: TripSettings) -> TripResult:
    return evaluate_trip(*item, settings)
