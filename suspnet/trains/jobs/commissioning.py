"""Commission the vehicle that a folder of healthy trips shows."""

import logging
from dataclasses import replace
from functools import partial
from pathlib import Path

from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.checkpoint import write_model
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.parameters import SIDES
from suspnet.ground.storage import write_json
from suspnet.ground.tensors import threads
from suspnet.runs.train import environment
from suspnet.trains.fits.bogie_fit import EXPLAINED, FURTHER_PARTS, commission_bogie
from suspnet.trains.identification import commissioning_summary as words
from suspnet.trains.identification.healthy_trips import HealthyTrips
from suspnet.trains.recordings.errors import all_of
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.sensors.swapped_sensors import NEARLY, check_bogie, check_order
from suspnet.vehicle import ResponseGenerator, VerticalVehicle
from suspnet.vehicle.quantities import PARTS, LogNormal

log = logging.getLogger(__name__)
FAMILY = tuple(part for part in PARTS if part != "air_spring")
"""Parts of the vehicle that is commissioned if the configuration names none."""
SIDE_M = dict(zip(SIDES, (1.0, -1.0), strict=True))
"""Assumed lateral position of a sensor if only its side is known, [m]."""


# one thread: systems of 30 equations are too small for two, and results are the same anywhere
@threads(1)
def commission_parts(healthy: HealthyTrips, trips: TripSettings) -> CommissionedBogie:
    """Return the bogie that healthy trips show: each part, or all of a kind as equal.

    TripError if sensors look swapped, or the trips show the other bogie.
    """
    vehicle = healthy.vehicle
    folder = healthy.manifests[0].path.parent
    for reason in healthy.left_out:
        log.warning("left out of the healthy trips: %s", reason)
    for doubt in healthy.doubts:  # before the search, which takes minutes
        log.warning("%s", doubt)

    def check_orders(nearly: float) -> None:
        all_of(
            partial(check_order, vehicle, trip, str(manifest.path), nearly=nearly)
            for trip, manifest in zip(healthy.of_parts, healthy.manifests, strict=True)
        )

    if trips.check_channels:
        check_orders(1.0)
    temperatures_c = [manifest.temperature_c for manifest in healthy.manifests]
    trips_of = healthy.of_parts
    bogie = commission_bogie(vehicle, trips_of, temperatures_c, further_parts=FURTHER_PARTS)
    if trips.check_channels and bogie.misfit > EXPLAINED:
        check_orders(NEARLY)
        check_bogie(vehicle, trips_of, bogie.misfit, str(folder))
    log.info("%s", words.of_parts(bogie))
    for doubt in words.doubts_of_parts(bogie):
        log.warning("%s", doubt)
    if bogie.misfit > EXPLAINED and (hint := words.unplaced(healthy)):
        log.warning("%s", hint)
    return bogie


def write_bogie_model(folder: Path, model: BogieModel) -> None:
    """Write a commissioned bogie to a run's folder; metrics.json marks it as finished."""
    write_model(folder, model)
    write_json(folder / "environment.json", environment())
    metrics = {"model": model.name, "vehicle": model.vehicle.name, "misfit": model.bogie.misfit}
    write_json(folder / "metrics.json", metrics)


def check_generator(generator: ResponseGenerator) -> VerticalVehicle:
    """Return a generator that can be commissioned; ValueError if it cannot."""
    if not isinstance(generator, VerticalVehicle):
        raise ValueError(
            f"vehicle {generator.vehicle.name!r} cannot be commissioned as a "
            f"{type(generator).__name__}: give its geometry, and generator=family"
        )
    return generator


def prior_of(generator: VerticalVehicle, healthy: HealthyTrips) -> VerticalVehicle:
    """Return the generator with parts, sensor positions and a prior to start from."""
    # each channel's lateral position: 0 for a pair, else as given, else by its side
    manifest, given_m = healthy.manifests[0], generator.sensor_lateral_m
    sides = {name: manifest.side_of(sensor) for name, sensor in manifest.sensors().items()}
    box_m, frame_m, body_m = (
        0.0 if is_pair else stated_m or SIDE_M.get(sides.get(name) or "", 0.0)
        for stated_m, is_pair, name in zip(given_m, healthy.paired, CHANNELS, strict=True)
    )
    lateral_m = box_m, frame_m, body_m
    parts = generator.parts or FAMILY
    if not any(lateral_m):  # sensors in the middle do not see roll
        parts = tuple(part for part in parts if part != "roll")
    placed = replace(generator, parts=parts, sensor_lateral_m=lateral_m)
    if placed.distribution is None:
        placed = replace(placed, distribution=LogNormal.prior(parts))
    return placed
