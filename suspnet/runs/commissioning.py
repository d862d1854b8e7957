"""Commission the vehicle that a folder of healthy trips shows."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from suspnet.dynamics import ResponseGenerator, SpatialVehicle, VerticalVehicle
from suspnet.dynamics.quantities import PARTS, LogNormal
from suspnet.estimation import commissioning_summary as words
from suspnet.estimation.bogie_fit import CommissionedBogie, commission_bogie
from suspnet.estimation.bogie_trips import PARTS_OF_BOGIE, bogie_trip, sensor_places, show_parts
from suspnet.estimation.commissioning import Commissioned, commission
from suspnet.estimation.healthy_trips import HealthyTrips, read_healthy
from suspnet.estimation.lone_sensors import SIDE_M
from suspnet.estimation.swapped_sensors import check_bogie, check_order
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.parameters import Direction
from suspnet.ground.tensors import threads
from suspnet.recordings.errors import TripError, all_of
from suspnet.recordings.manifest import CHANNELS, LEAST_SENSORS, TripManifest
from suspnet.recordings.manifest_files import ManifestFile
from suspnet.recordings.recording import load_recording
from suspnet.spectra.estimates import EstimateSettings

log = logging.getLogger(__name__)
SETTINGS = ("bogie", "axle", "frame_sensor", "body_sensor_m", "nominal")
"""Settings that the vehicle of the parts shares with the vertical one."""
FAMILY = tuple(part for part in PARTS if part != "air_spring")
"""Parts of the vehicle that is commissioned if the configuration names none."""


@threads(1)  # a second process may be about to start
def read_folder(
    folder: Path,
    generator: ResponseGenerator,
    settings: EstimateSettings,
    trips: TripSettings,
    *,
    paths: Sequence[ManifestFile] | None = None,
    n_first: int | None = None,
    progress: bool = False,
) -> HealthyTrips:
    """Return the healthy trips of a folder.

    `paths` are the manifests of one suspension if the folder holds several; only the `n_first`
    trips by mileage are used. Raises FileNotFoundError or TripError if the folder does not hold at
    least three healthy trips of one suspension of the vehicle and its bogie, ValueError if the
    generator cannot be commissioned.
    """
    generator = check_generator(generator)
    settings = settings.bound(generator.vehicle)
    return read_healthy(
        folder, generator, settings, trips, paths=paths, n_first=n_first, progress=progress
    )


def commission_trips(
    found: HealthyTrips,
    generator: ResponseGenerator,
    settings: EstimateSettings,
    *,
    by_part: bool = False,
    progress: bool = False,
) -> Commissioned:
    """Return the vehicle that healthy trips show.

    `generator` is the nominal vehicle; without parts it gets all but the air spring, without a
    distribution the prior of its parts. If each part is to be read, this vehicle is only for trips
    that do not show their parts. ValueError if the generator cannot be commissioned.
    """
    generator = check_generator(generator)
    settings = settings.bound(generator.vehicle)
    outcome = commission(_prior(generator, found), settings, found.groups, progress=progress)
    if by_part:
        log.info("%s%s", words.AS_EQUAL, words.verdict(found, outcome))
        return outcome
    log.info("%s %s", words.verdict(found, outcome), words.agreement(outcome))
    for doubt in [*words.doubts(outcome), words.mass_doubt(outcome.masses)]:
        if doubt:
            log.warning("%s", doubt)
    if not words.is_explained(outcome) and not any(generator.sensor_lateral_m):
        if hint := words.unplaced(found):
            log.warning("%s", hint)
    if hint := words.other_minutes(found, settings):
        log.info("%s", hint)
    return outcome


def commission_folder(
    folder: Path,
    generator: ResponseGenerator,
    settings: EstimateSettings,
    trips: TripSettings,
    *,
    n_first: int | None = None,
    progress: bool = False,
) -> tuple[HealthyTrips, Commissioned]:
    """Return the healthy trips of a folder and the vehicle that they show.

    It takes and raises what `read_folder` and `commission_trips` do.
    """
    found = read_folder(folder, generator, settings, trips, n_first=n_first, progress=progress)
    return found, commission_trips(found, generator, settings, progress=progress)


def parts_of(
    found: HealthyTrips, generator: ResponseGenerator, trips: TripSettings
) -> Callable[[], CommissionedBogie]:
    """Return what commissions the bogie that healthy trips show, part by part.

    The result can be pickled, to be called in another process, which reads the recordings again.
    `generator` gives vehicle and bogie, the manifests give the places of sensors. TripError is
    raised if these do not show the parts, when called NoEstimateError if a trip is too short.
    """
    generator = check_generator(generator)
    folder, frame_sensor = found.manifests[0].path.parent, generator.frame_sensor
    several = {sensor_places(manifest, frame_sensor) for manifest in found.manifests}
    if len(several) > 1:
        raise TripError(
            f"{folder}: the healthy trips differ in their sensors; take those of one layout"
        )
    sensors = several.pop()
    if not show_parts(sensors):
        raise TripError(
            f"{folder}: each part is read from at least {LEAST_SENSORS} sensors on both sides, "
            f"best left and right at axle box, frame and body, the healthy trips have "
            f"{', '.join(sensors) or 'none'}: give all sensors in the manifests with "
            "`side` and `axle`, or take protocol=trips"
        )
    vehicle = SpatialVehicle(
        generator.vehicle,
        **{name: getattr(generator, name) for name in SETTINGS},
        parts=PARTS_OF_BOGIE,
        sensors=sensors,
    ).with_prior()
    directions = {group.trip: group.direction for group in found.groups}
    each = [(manifest, directions[i]) for i, manifest in enumerate(found.manifests)]
    return partial(_commissioned_bogie, vehicle, each, trips)


# one thread: systems of 30 equations are too small for two, and results are the same anywhere
@threads(1)
def _commissioned_bogie(
    vehicle: SpatialVehicle,
    each: Sequence[tuple[TripManifest, Direction]],
    trips: TripSettings,
) -> CommissionedBogie:
    read = [
        bogie_trip(load_recording(manifest, trips.rate_hz), vehicle, trips, direction)
        for manifest, direction in each
    ]
    if trips.check_channels:
        all_of(
            partial(check_order, vehicle, trip, f"{manifest.path}: ")
            for (manifest, _), trip in zip(each, read, strict=True)
        )
    found = commission_bogie(vehicle, read)
    if trips.check_channels:
        check_bogie(vehicle, read, found.misfit, f"{each[0][0].path.parent}: ")
    return found


def reported(bogie: CommissionedBogie) -> CommissionedBogie:
    """Return a bogie whose healthy parts, and whether its search ended, are now in the log."""
    log.info("%s", words.of_parts(bogie))
    for doubt in words.doubts_of_parts(bogie):
        log.warning("%s", doubt)
    return bogie


def check_generator(generator: ResponseGenerator) -> VerticalVehicle:
    """Return a generator that can be commissioned; ValueError if it cannot."""
    if not isinstance(generator, VerticalVehicle):
        raise ValueError(
            f"vehicle {generator.vehicle.name!r} cannot be commissioned as a "
            f"{type(generator).__name__}: give its geometry, and generator=family"
        )
    return generator


def _prior(generator: VerticalVehicle, found: HealthyTrips) -> VerticalVehicle:
    """Return the generator with parts, sensor positions and a prior to start from."""
    lateral_m = _lateral_m(generator.sensor_lateral_m, found)
    parts = generator.parts or FAMILY
    if not any(lateral_m):  # sensors in the middle do not see roll
        parts = tuple(part for part in parts if part != "roll")
    placed = replace(generator, parts=parts, sensor_lateral_m=lateral_m)
    if placed.distribution is None:
        placed = replace(placed, distribution=LogNormal.prior(parts))
    return placed


def _lateral_m(given: Sequence[float], found: HealthyTrips) -> tuple[float, float, float]:
    """Return each channel's lateral position: 0 for a pair, else as given, else by its side."""
    manifest = found.manifests[0]
    sensors = manifest.sensors()
    box, frame, body = (
        0.0 if is_pair else lateral_m or SIDE_M.get(manifest.side_of(sensors[name]) or "", 0.0)
        for lateral_m, is_pair, name in zip(given, found.paired, CHANNELS, strict=True)
    )
    return box, frame, body
