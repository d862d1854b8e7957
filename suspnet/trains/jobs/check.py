"""Checks of manifests and recordings without a model: faults, and how much can be read."""

import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import NoEstimateError
from suspnet.curves.welch import SegmentSpectra
from suspnet.estimation.fitted import Model
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding, together, with_values, without
from suspnet.ground.records import ERROR, OK
from suspnet.ground.storage import write_atomically
from suspnet.trains.identification.bogie_trips import sensor_places
from suspnet.trains.identification.from_recording import no_channel
from suspnet.trains.identification.rig_records import load_record, read_record, reading_of
from suspnet.trains.pages.check_page import (
    NEED_A_VEHICLE,
    PROBLEM,
    READY,
    TOO_LITTLE,
    SteadyPart,
    TripCheck,
    trip_figure,
)
from suspnet.trains.recordings.errors import TripError, all_of
from suspnet.trains.recordings.formats import open_columns
from suspnet.trains.recordings.manifest import CHANNELS, RecordManifest, TripManifest
from suspnet.trains.recordings.manifest_files import ManifestFile
from suspnet.trains.recordings.manifest_sources import channel_of
from suspnet.trains.recordings.recording import Recording, load_recording
from suspnet.trains.spectra import steady_parts
from suspnet.trains.spectra.segments import recording_segments, segment_speeds
from suspnet.trains.trips.commissionings import models_at, models_of
from suspnet.trains.trips.sensor_checks import NO_DIRECTION, ShownParts, check_bogie, check_sensors
from suspnet.trains.trips.trip import evaluate_recording
from suspnet.vehicle import Vehicle, best_generator
from suspnet.vehicle.quantities import show_parts
from suspnet.vehicle.rig import Rig

log = logging.getLogger(__name__)
UNKNOWN_BAND_HZ = (0.5, 20.0)
"""Band used for an unknown vehicle, that of most railway vehicles, [Hz]."""
Opened = dict[tuple[Path, str | None, str | None], tuple[str, ...]]
"""Why columns of a file cannot be opened, by file, times and column; empty if they can."""


@dataclass(frozen=True)
class CheckSettings:
    """How trips are checked.

    `vehicles` and `rigs` are known ones by the names that manifests use; `pictures` is the folder
    of the pictures (None: no pictures). A trip is ready if `models` read it, or, without models, if
    a model of its speed would. `with_losses`: whether to compute which losses would be named.
    """

    vehicles: Mapping[str, Vehicle]
    rigs: Mapping[str, Rig] = field(default_factory=dict)
    trips: TripSettings = field(default_factory=TripSettings)
    pictures: Path | None = None
    models: Sequence[Model] = ()
    with_losses: bool = True


def check_trip(
    path: Path, settings: CheckSettings, picture: str = "", opened: Opened | None = None
) -> TripCheck:
    """Return what is wrong with a trip and how much of it can be read; it never fails.

    `path` is the manifest, and `picture` a file name in the settings' folder. `opened` is shared by
    the manifests of a folder, so that each column is opened once.
    """
    opened = {} if opened is None else opened
    result = TripCheck(path)
    try:
        file = ManifestFile(path)
        manifest, _ = all_of([lambda: file.trip, lambda: _check_columns(file, opened)])
        result = _described(path, manifest)
        if isinstance(manifest, RecordManifest):
            return _of_rig(result, manifest, settings)
        if manifest.vehicle in settings.rigs:
            return _with_problems(result, ["the manifest is of a train's trip, its vehicle a rig"])
        recording = load_recording(manifest, settings.trips.rate_hz)
        return _inspected(result, recording, settings, picture)
    except TripError as error:
        return _with_problems(result, error.problems)
    except Exception as error:  # one faulty trip must not hide the faults of others
        log.debug("trip %s failed", path, exc_info=True)
        return _with_problems(result, [f"{type(error).__name__}: {' '.join(str(error).split())}"])


def _check_columns(file: ManifestFile, opened: Opened) -> None:
    """Raise TripError if a column of the manifest cannot be opened, whatever else is wrong.

    Only the first block is read. A missing file is reported by the check of the manifest.
    """
    problems: dict[str, None] = {}
    for source in file.sources.values():
        data = file.path.parent / source["file"]
        time, column = source.get("time"), source.get("column")
        named = all(name is None or isinstance(name, str) for name in (time, column))
        if not named or source.get("csv") is not None or not os.path.isfile(data):
            continue  # how a CSV file is written is known only when the manifest is parsed
        key = (data, time, column)
        if key not in opened:
            try:
                next(iter(open_columns(data, [column] if time is None else [time, column])), None)
                opened[key] = ()
            except TripError as error:
                opened[key] = error.problems
        problems |= dict.fromkeys(opened[key])
    if problems:
        raise TripError(*problems)


def _printable(words: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in words)


def _with_problems(result: TripCheck, problems: Iterable[str]) -> TripCheck:
    shown = tuple(
        without(result.manifest, with_values(problem, _printable)) for problem in problems
    )
    return replace(result, state=PROBLEM, problems=shown)


def _with_remarks(result: TripCheck, *remarks: str, **changes: Any) -> TripCheck:
    return replace(result, remarks=(*result.remarks, *filter(None, remarks)), **changes)


def _described(path: Path, manifest: TripManifest) -> TripCheck:
    pairs = [name for name in CHANNELS if manifest.is_pair(name)]
    single = Finding("pairs", pairs=together(pairs, ", ")) if pairs else "single sensors"
    others = together([name for name in manifest.sensors() if not channel_of(name)], ", ")
    return TripCheck(
        path,
        vehicle=manifest.vehicle,
        place=manifest.place,
        mileage_km=manifest.mileage_km,
        sensors=together(("pairs" if len(pairs) == len(CHANNELS) else single, others)),
        sources=tuple(
            f"{manifest.file_of(sensor).resolve()}: {sensor.column or ''}"
            for sensor in manifest.sensors().values()
        ),
    )


def _inspected(
    result: TripCheck, recording: Recording, settings: CheckSettings, picture: str
) -> TripCheck:
    """Return a check with the content of the recording; draw it if asked."""
    vehicle, estimate, remark = _vehicle(recording.manifest, settings.vehicles)
    assert estimate.low_hz is not None
    assert estimate.high_hz is not None
    unknown = 100 * float(np.isnan(recording.speed_m_per_s).mean())
    result = _with_remarks(
        result,
        recording.words,
        *map(str, recording.faults),
        remark,
        Finding("speed-partly-unknown", unknown=unknown) if unknown else "",
        Finding("single-in-middle") if recording.manifest.unplaced else "",
        duration_s=recording.duration_s,
        usable_percent=100 * float(recording.usable.mean()),
        band_hz=(estimate.low_hz, estimate.high_hz),
        unchecked=vehicle is None and not settings.models,
    )
    # without a channel there is no mean of both sides, but perhaps each part
    if recording.absent:
        result = _with_remarks(result, no_channel(recording), state=TOO_LITTLE)
        if settings.models:
            return _read(result, recording, settings)
        return result if vehicle is None else _of_parts(result, recording, vehicle, settings)
    segments = recording_segments(recording, estimate.welch)
    at_any_speed = vehicle is not None and best_generator(vehicle).speed_m_per_s is None
    result, checked = _at_steady_speeds(
        result, recording, segments, estimate, settings.trips, at_any_speed
    )
    if settings.models:
        result = _read(result, recording, settings)
    looked_at = checked[0]
    spectra = segments.average(looked_at) if bool(looked_at.any()) else None
    if settings.pictures is not None and picture:
        title = f"{result.manifest.stem}: {result.words}"
        image = trip_figure(recording, segments.frequencies_hz, spectra, result.band_hz, title)
        write_atomically(settings.pictures / picture, image)
        result = replace(result, picture=picture)
    # channels can be tested for a swap only against a known vehicle
    if vehicle is None or spectra is None or result.state == PROBLEM:
        return result
    try:
        doubts, shown, frame_sensor = check_sensors(
            recording, segments, checked, vehicle, estimate, settings.trips
        )
    except TripError as error:
        return _with_problems(result, error.problems)
    result = _with_remarks(result, *doubts, frame_sensor=frame_sensor)
    if isinstance(shown, NoEstimateError):  # training leaves the trip out; models decide themselves
        return result if settings.models else _with_remarks(result, str(shown), state=TOO_LITTLE)
    return result if shown is None else _with_losses(result, shown, settings)


def _of_rig(result: TripCheck, manifest: RecordManifest, settings: CheckSettings) -> TripCheck:
    """Return the check of a record of a rig."""
    record, rig = load_record(manifest), settings.rigs.get(manifest.vehicle)
    assert record.usable is not None
    result = _with_remarks(
        result,
        record.faults,
        duration_s=record.signals.shape[1] / record.rate_hz,
        usable_percent=100 * float(record.usable.mean()),
        unchecked=rig is None,
        is_rig=True,
    )
    if rig is None:
        unknown = f"the numbers of the rig {manifest.vehicle!r} are not known"
        return _with_remarks(result, unknown, state=TOO_LITTLE)
    result = replace(result, band_hz=rig.band_hz)
    try:
        reading = read_record(rig, record, *reading_of(rig, [record]))
    except NoEstimateError as reason:
        return _with_remarks(result, str(reason), state=TOO_LITTLE)
    values = reading.values
    alone = (
        f"frame alone at {values['primary_hz']:.3g} Hz, body alone at "
        f"{values['secondary_hz']:.3g} Hz"
    )
    return _with_remarks(result, alone, reading.doubt, state=READY)


def _vehicle(
    manifest: TripManifest, vehicles: Mapping[str, Vehicle]
) -> tuple[Vehicle | None, EstimateSettings, str]:
    """Return a trip's vehicle if its numbers are known, its settings, and a remark if not."""
    plain = EstimateSettings()
    vehicle = vehicles.get(manifest.vehicle)
    if vehicle is None:
        remark = Finding(
            "vehicle-unknown",
            need_a_vehicle=NEED_A_VEHICLE,
            vehicle=repr(manifest.vehicle),
            vehicles=sorted(vehicles),
        )
    else:
        try:
            return vehicle, plain.bound(vehicle), ""
        except ValueError as error:
            remark = Finding("vehicle-reason", name=repr(manifest.vehicle), words=str(error))
    low_hz, high_hz = UNKNOWN_BAND_HZ
    return None, replace(plain, low_hz=low_hz, high_hz=high_hz), remark


def _read(result: TripCheck, recording: Recording, settings: CheckSettings) -> TripCheck:
    """Return a check that is ready if the models estimate the recording."""
    manifest = recording.manifest
    try:
        models = models_of(settings.models, manifest.place)
        words = steady_parts.readable_words(models_at(models, manifest.mileage_km))
    except ValueError as error:
        return _with_problems(result, [str(error)])
    outcome = evaluate_recording(manifest, lambda: recording, models, settings.trips)
    if outcome.status == ERROR:
        return _with_problems(replace(result, read_by=words), [outcome.reason])
    state = READY if outcome.status == OK else TOO_LITTLE
    return _with_remarks(result, outcome.reason, read_by=words, state=state)


def _at_steady_speeds(
    result: TripCheck,
    recording: Recording,
    segments: SegmentSpectra,
    estimate: EstimateSettings,
    settings: TripSettings,
    at_any_speed: bool,
) -> tuple[TripCheck, list[Tensor]]:
    """Return a check with a recording's steady speeds, and their segments, the longest first.

    Without steady speeds these are all segments, or the longest group.
    """
    n_segments = len(segments.values)
    every = torch.ones(n_segments, dtype=torch.bool)
    if not n_segments:
        nothing = Finding("no-faultless-stretch", segment_s=estimate.segment_s)
        return _with_remarks(result, nothing, state=TOO_LITTLE), [every]
    speeds = segment_speeds(recording, segments)
    tolerance, least = settings.speed_tolerance, settings.min_speed_m_per_s
    # group, average and judge as the evaluation does, so that both agree on what is enough
    groups = steady_parts.groups_to_read(speeds, tolerance, least, at_any_speed=at_any_speed)
    seen = [
        part
        for part in steady_parts.steady(segments, speeds, groups, estimate, settings)
        if part.spectra is not None
    ]
    enough = [part for part in seen if part.has_enough]
    certain = [part for part in enough if part.is_certain]
    # the reason why there is too little, or which of the speeds are not certain enough
    if enough:
        remark = together(
            Finding(
                "responses-uncertain-at",
                speed_m_per_s=part.speed[0],
                deviation_percent=100 * part.deviation,
                max_deviation=100 * settings.max_deviation,
            )
            for part in enough
            if not part.is_certain
        )
    else:
        most = max(seen, key=lambda part: part.n_averages, default=None)
        n_most = int(most.chosen.sum()) if most else 0
        remark = Finding(
            "too-little-at" if most else "too-little-steady",
            m_per_s=most.speed[0] if most else None,
            minutes=steady_parts.minutes_words(segments.welch, n_most, settings.min_averages),
            tolerance=100 * tolerance,
            least=least,
        )
    parts = [
        SteadyPart(part.speed[0], part.n_averages, p, s, 100 * part.deviation)
        for part in certain
        for p, s in [part.coherences]
    ]
    result = _with_remarks(
        result,
        remark,
        state=READY if certain else TOO_LITTLE,
        parts=tuple(parts),
        steady_percent=100 * sum(int(part.chosen.sum()) for part in certain) / n_segments,
    )
    return result, [part.chosen for part in certain or seen[:1]] or [every]


def _of_parts(
    result: TripCheck, recording: Recording, vehicle: Vehicle, settings: CheckSettings
) -> TripCheck:
    """Return the check of a recording whose sensors can show nothing but each part."""
    way = recording.manifest.direction
    if way is None and show_parts(sensor_places(recording.manifest, "axle")):
        return _with_remarks(result, NO_DIRECTION)
    try:
        shown = check_bogie(recording, vehicle, settings.trips, [way] if way else [])
    except TripError as error:
        return _with_problems(result, error.problems)
    except NoEstimateError as reason:
        return _with_remarks(result, str(reason))
    if shown is None:
        return result
    unknown = [float("nan")] * 3
    part = SteadyPart(shown.trip.speed_m_per_s, shown.trip.spectra.n_averages, *unknown)
    return _with_losses(replace(result, state=READY, parts=(part,)), shown, settings)


def _with_losses(result: TripCheck, shown: ShownParts, settings: CheckSettings) -> TripCheck:
    losses = shown.least_losses() if settings.with_losses else {}
    return replace(result, shows_parts=True, least_losses=losses)
