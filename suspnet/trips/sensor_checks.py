"""Checks whether the sensors of a trip are where its manifest says, against a known vehicle."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from functools import cache, partial
from typing import Any

from torch import Tensor

from suspnet.dynamics import SpatialVehicle, Vehicle, best_generator
from suspnet.estimation.bogie_trips import PARTS_OF_BOGIE, bogie_trip, sensor_places, show_parts
from suspnet.estimation.swapped_sensors import NEARLY, check_end, check_order, misfit_near
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.parameters import Direction
from suspnet.ground.tensors import threads
from suspnet.recordings.errors import all_of
from suspnet.recordings.manifest import TripManifest
from suspnet.recordings.recording import Recording
from suspnet.spectra.bogie_trip import BogieTrip
from suspnet.spectra.plausibility import (
    DIRECTION_MARGIN,
    check_channels,
    check_pairs,
    shown_direction,
)
from suspnet.spectra.segments import NoEstimateError, difference_segments, segment_speeds
from suspnet.spectra.welch import SegmentSpectra

NO_DIRECTION = (
    "the phases do not show the direction of travel: give `direction: forward` or `direction: "
    "reverse`"
)


def check_sensors(
    recording: Recording,
    segments: SegmentSpectra,
    checked: Sequence[Tensor],
    vehicle: Vehicle,
    settings: TripSettings,
) -> tuple[tuple[str, ...], bool]:
    """Return doubts about the sensors, and whether they show each part of a bogie.

    `checked` are the segments of the steady parts. TripError if the signals contradict the places
    that the manifest gives the sensors.
    """
    doubts: list[str] = []
    ways = [way] if (way := recording.manifest.direction) else []

    def check_channel_order(chosen: Tensor) -> None:
        speed = float(segment_speeds(recording, segments)[chosen].mean())
        manifest, frequencies_hz = recording.manifest, segments.frequencies_hz
        generator = best_generator(vehicle, speed_m_per_s=speed, **_measured_at(manifest))
        spectra, single = segments.average(chosen), not all(recording.paired)
        shown, factor = shown_direction(spectra, frequencies_hz, generator)
        # in reverse the leading bogie moves like the trailing one: unnamed, either will do
        said = manifest.direction if manifest.bogie else None
        generator = generator.running(said or shown)
        if generator.direction and not manifest.direction:
            if factor < DIRECTION_MARGIN:
                doubts.append(NO_DIRECTION)
            else:
                ways.append(shown)
        doubts.append(check_channels(spectra, frequencies_hz, generator, vehicle, doubtful=single))

    def check_sides(chosen: Tensor) -> None:
        differences = difference_segments(recording, segments.welch)
        check_pairs(segments, differences, chosen, recording.paired, vehicle)

    def check_parts() -> BogieTrip | None:
        with contextlib.suppress(NoEstimateError):  # what can be read is said elsewhere
            return check_bogie(recording, vehicle, settings, ways)
        return None

    parts = [check_channel_order, *([check_sides] if any(recording.paired) else [])]
    each = [partial(part, chosen) for part in parts for chosen in checked]
    *_, trip = all_of([*each, check_parts])
    return tuple(dict.fromkeys(filter(None, doubts))), trip is not None


@threads(1)  # as for estimates: systems of 30 equations are too small for two
def check_bogie(
    recording: Recording, vehicle: Vehicle, settings: TripSettings, ways: Sequence[Direction]
) -> BogieTrip | None:
    """Return the stretch of a recording that shows each part of a bogie; None without the sensors.

    NoEstimateError if no stretch is long enough, TripError if two of the sensors look swapped, or
    are at another bogie or axle than the manifest says. `ways` are the directions of travel of the
    recording's parts, empty if unknown.
    """
    places = sensor_places(recording.manifest, "axle")
    if not ways or not show_parts(places):
        return None
    manifest = recording.manifest
    unknown = SpatialVehicle(
        vehicle, **_measured_at(manifest), parts=PARTS_OF_BOGIE, sensors=places
    ).with_prior()
    trip = bogie_trip(recording, unknown, settings, ways[0])
    fit = cache(partial(misfit_near, unknown, trip))
    if manifest.direction:  # else that which the phases show assumes the bogie
        check_end(unknown, trip, fit=fit)
    check_order(unknown, trip, nearly=NEARLY, fit=fit)
    return trip


def _measured_at(manifest: TripManifest) -> dict[str, Any]:
    """Return bogie and axle of a manifest, the leading ones where it names none."""
    return {"bogie": manifest.bogie or "leading", "axle": manifest.axle or "leading"}
