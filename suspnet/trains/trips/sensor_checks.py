"""Checks whether the sensors of a trip are where its manifest says, against a known vehicle."""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

from torch import Tensor

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import NoEstimateError, Speeds
from suspnet.curves.welch import SegmentSpectra
from suspnet.estimation.trip_settings import N_HEALTHY, TripSettings
from suspnet.ground.findings import Finding, kind_is, parts_of
from suspnet.ground.parameters import Direction
from suspnet.ground.tensors import threads
from suspnet.trains.fits.healthy_misfit import HealthySpectra
from suspnet.trains.fits.worn_parts import expected_losses
from suspnet.trains.identification.bogie_trips import PARTS_OF_BOGIE, sensor_places
from suspnet.trains.identification.healthy_trips import trip_of_all_sensors
from suspnet.trains.recordings.errors import all_of
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.sensors.plausibility import (
    DIRECTION_MARGIN,
    check_channels,
    check_pairs,
    shown_direction,
)
from suspnet.trains.sensors.swapped_sensors import (
    EXPLAINS,
    NEARLY,
    check_end,
    check_order,
    elsewhere,
    misfit_near,
)
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.segments import difference_segments, in_band, segment_speeds
from suspnet.trains.spectra.steady_parts import speed_of
from suspnet.vehicle import SpatialVehicle, Vehicle, VerticalVehicle, best_generator
from suspnet.vehicle.quantities import show_parts

NO_DIRECTION = Finding("direction-not-shown")
BY_CURVES = ("speed-unit-wrong", "order-unclear", "if-sure")
"""Findings of `check_channels` that are doubts of single sensors."""


@dataclass(frozen=True)
class ShownParts:
    """A stretch that shows each part of a bogie, the vehicle with its prior, and their misfit."""

    vehicle: SpatialVehicle
    trip: BogieTrip
    misfit: Callable[[], float]

    def least_losses(self) -> Mapping[str, float]:
        """Return the `expected_losses` of each part after ``N_HEALTHY`` trips like it, [-]."""
        return expected_losses(self.vehicle, self.trip, N_HEALTHY)


def check_sensors(
    recording: Recording,
    segments: SegmentSpectra,
    checked: Sequence[Tensor],
    vehicle: Vehicle,
    estimate: EstimateSettings,
    settings: TripSettings,
) -> tuple[tuple[str, ...], ShownParts | NoEstimateError | None, str]:
    """Return doubts about the sensors, what they show of each part, and where the frame's is.

    The second is why training would leave the trip out, if it would, the last "axle" or "centre".
    `checked` are the segments of the steady parts, the longest first; `estimate` is bound to the
    vehicle. TripError if the signals contradict the places that the manifest gives the sensors.
    """
    doubts: list[str] = []
    ways = [way] if (way := recording.manifest.direction) else []
    place: dict[str, Any] = {}
    if bool(checked[0].any()):
        place = _frame_place(recording, segments, checked[0], vehicle, estimate, doubts)

    def check_channel_order(chosen: Tensor) -> None:
        speed = float(segment_speeds(recording, segments)[chosen].mean())
        manifest, frequencies_hz = recording.manifest, segments.frequencies_hz
        generator = best_generator(vehicle, speed_m_per_s=speed, **(_measured_at(manifest) | place))
        spectra, single = segments.average(chosen), not all(recording.paired)
        shown, factor = shown_direction(spectra, frequencies_hz, generator)
        # in reverse the leading bogie moves like the trailing one: unnamed, either will do
        stated = manifest.direction if manifest.bogie else None
        generator = generator.running(stated or shown)
        if generator.direction and not manifest.direction:
            if factor < DIRECTION_MARGIN:
                doubts.append(NO_DIRECTION)
            else:
                ways.append(shown)
        doubts.append(check_channels(spectra, frequencies_hz, generator, vehicle, doubtful=single))

    def check_sides(chosen: Tensor) -> None:
        differences = difference_segments(recording, segments.welch)
        check_pairs(segments, differences, chosen, recording.paired, vehicle)

    def check_parts() -> ShownParts | NoEstimateError | None:
        try:
            return check_bogie(recording, vehicle, settings, ways, place)
        except NoEstimateError as reason:
            return reason

    # all checks run, so that all problems are reported at once
    of_segments = [check_channel_order, *([check_sides] if any(recording.paired) else [])]
    each = [partial(check, chosen) for check in of_segments for chosen in checked]
    *_, shown_parts = all_of([*each, check_parts])
    frame_sensor = place.get("frame_sensor", "axle")
    if not all(recording.paired) and isinstance(shown_parts, ShownParts):
        # curves of single sensors ignore the roll that the parts explain
        findings = [part for doubt in doubts for part in parts_of(doubt)]
        others = [part for part in findings if not any(kind_is(part, kind) for kind in BY_CURVES)]
        if len(others) < len(findings) and shown_parts.misfit() < EXPLAINS:
            doubts = others
    return tuple(dict.fromkeys(filter(None, doubts))), shown_parts, frame_sensor


def _frame_place(
    recording: Recording,
    segments: SegmentSpectra,
    chosen: Tensor,
    vehicle: Vehicle,
    estimate: EstimateSettings,
    doubts: list[str],
) -> dict[str, Any]:
    """Return the place of the frame's sensor if it looks to be elsewhere, and add that doubt."""
    speeds = segment_speeds(recording, segments)[chosen]
    manifest = recording.manifest
    generator = best_generator(
        vehicle, speed_m_per_s=float(speeds.mean()), **_measured_at(manifest)
    )
    if not isinstance(generator, VerticalVehicle):
        return {}
    with contextlib.suppress(NoEstimateError):  # the band is reported elsewhere
        band = in_band(segments, estimate.frequencies_hz())
        at = Speeds.of(*speed_of(speeds, band))
        trip = HealthySpectra(at, band.average(chosen))
        other = elsewhere(generator, estimate, trip, manifest.direction)
        # another axle or direction is an error of the checks below
        if other is not None and other.best.vehicle.frame_sensor != generator.frame_sensor:
            doubts.append(str(other))
            return {"frame_sensor": other.best.vehicle.frame_sensor}
    return {}


@threads(1)  # as for estimates: systems of 30 equations are too small for two
def check_bogie(
    recording: Recording,
    vehicle: Vehicle,
    settings: TripSettings,
    ways: Sequence[Direction],
    place: Mapping[str, Any] | None = None,
) -> ShownParts | None:
    """Return what a recording shows of each part of a bogie; None without the sensors.

    NoEstimateError if training would leave the trip out, TripError if two of the sensors look
    swapped, or are at another bogie or axle than the manifest says. `ways` are the directions of
    travel of the recording's parts, empty if unknown; `place` is that of the frame's sensor, if it
    is not usual.
    """
    place = place or {}
    places = sensor_places(recording.manifest, place.get("frame_sensor", "axle"))
    if not ways or not show_parts(places):
        return None
    manifest = recording.manifest
    unknown = SpatialVehicle(
        vehicle, **_measured_at(manifest), **place, parts=PARTS_OF_BOGIE, sensors=places
    ).with_prior()
    trip = trip_of_all_sensors(recording, unknown, settings, ways[0])
    fit = cache(partial(misfit_near, unknown, trip))
    if manifest.direction:  # else that which the phases show assumes the bogie
        check_end(unknown, trip, fit=fit)
    check_order(unknown, trip, nearly=NEARLY, fit=fit)
    return ShownParts(unknown, trip, fit)


def _measured_at(manifest: TripManifest) -> dict[str, Any]:
    return {"bogie": manifest.bogie or "leading", "axle": manifest.axle or "leading"}
