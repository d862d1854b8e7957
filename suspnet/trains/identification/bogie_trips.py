"""From a recording with sensors left and right to the estimate of each part of a bogie."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from suspnet.curves.speeds import NoEstimateError
from suspnet.curves.welch import Welch
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.estimate import Estimate
from suspnet.estimation.flags import with_bogie_doubt
from suspnet.estimation.intervals import LARGEST_MISFIT
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding, at, together
from suspnet.ground.parameters import COMPONENTS, FORWARD, SIDES, Direction
from suspnet.trains.fits.bogie_fit import fit_parts
from suspnet.trains.fits.worn_parts import worn_parts
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import LEAST_SENSORS, TripManifest
from suspnet.trains.recordings.manifest_sources import MIDDLE
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.sensors.swapped_sensors import check_order
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.segments import segment_speeds, sensor_segments, without_loud
from suspnet.trains.spectra.steady_parts import groups_to_read, minutes_words
from suspnet.trains.spectra.subspace import SpectralMatrix
from suspnet.trains.spectra.wheel_lines import line_bins, wheel_lines
from suspnet.vehicle import SpatialVehicle, VerticalVehicle
from suspnet.vehicle.quantities import IN_BETWEEN, PLACES

PARTS_OF_BOGIE = (
    *("bushings", "rubber", "guidance", "longitudinal", "bending", "payload", "sensors"),
    *("frame_sway", "frame_yaw", "body_yaw", "creep", "torsion", "yaw_dampers"),
)
"""What a vehicle whose parts are read may have besides rigid bodies on springs and dampers."""
SHARED = ("bogie", "axle", "frame_sensor", "body_sensor_m", "nominal")
"""Settings that it shares with the vehicle of both sides as equal."""
SEGMENT_S = 120.0
"""Length of a segment. The leakage of a Hann window of 20 s leaves a misfit of 4 to 7, of 60 s 1.4
and of 120 s 1.05 (stepped trips of 20 minutes of the tests' rich train)."""
LOW_HZ, HIGH_HZ = 0.5, 18.0
"""Ends of the band: below, accelerometers drift; above, frame and body have modes of their own."""
SPACING_HZ = 0.1
"""Distance of the bins, far enough for them to be independent."""
UNEXPLAINED = "all sensors together fit no bogie, however worn its parts are"
"""Why the estimate of both sides as equal is flagged where that of the parts failed."""


class UnexplainedError(NoEstimateError):
    """No bogie whose parts alone have changed explains the trip."""


def bogie_vehicle(manifests: Sequence[TripManifest], generator: VerticalVehicle) -> SpatialVehicle:
    """Return the vehicle, with its prior, whose parts the sensors of some trips show.

    `generator` gives vehicle and bogie, the manifests give the places of sensors. TripError is
    raised if these differ, or do not show the parts.
    """
    folder = manifests[0].path.parent
    several = {sensor_places(manifest, generator.frame_sensor) for manifest in manifests}
    if len(several) > 1:
        raise TripError(at(folder, "sensors-differ-healthy"))
    sensors = several.pop()
    if not show_parts(sensors):
        raise TripError(
            at(
                folder,
                "too-few-sensors-for-parts",
                least_sensors=LEAST_SENSORS,
                sensors=", ".join(sensors) or "none",
            )
        )
    return SpatialVehicle(
        generator.vehicle,
        **{name: getattr(generator, name) for name in SHARED},
        parts=PARTS_OF_BOGIE,
        sensors=sensors,
    ).with_prior()


def bogie_trip(
    recording: Recording,
    generator: SpatialVehicle,
    settings: TripSettings | None = None,
    direction: Direction | None = None,
) -> BogieTrip:
    """Return the spectral matrix of a recording's largest stretch at one speed.

    If sensors of the generator's are missing or dead, or one whose faults leave no long stretch, it
    is that of the others (`lost` of the result). Bins with lines of out-of-round wheels of axle 1
    are left out.

    Parameters
    ----------
    recording : Recording
        With sensors at places of the generator's, named by its manifest.
    generator : SpatialVehicle
    settings : TripSettings, optional
        Tolerance of the speed, lowest speed.
    direction : {"forward", "reverse"}, optional
        Direction of travel; None: as the manifest says, else forward.

    Raises
    ------
    NoEstimateError
        If places of the generator have no sensor and the others do not show the parts, or no
        stretch at one speed is long enough for more averages than sensors, also without the sensor
        whose faults break it up the most.
    """
    settings = settings or TripSettings()
    try:
        return _trip_of_all(recording, generator, settings, direction)
    except NoEstimateError:
        if not recording.faulty:
            raise
        worst = max(recording.faulty, key=lambda name: int(recording.faulty[name].sum()))
        rest = recording.without(worst)
        try:
            return _trip_of_all(rest, generator, settings, direction)
        except NoEstimateError:
            pass
        raise


def _trip_of_all(
    recording: Recording,
    generator: SpatialVehicle,
    settings: TripSettings,
    direction: Direction | None,
) -> BogieTrip:
    """Return the spectral matrix of all sensors of a recording, as of `bogie_trip`."""
    assert generator.sensors is not None
    lost = _lost_sensors(recording, generator)
    n_sensors = len(generator.sensors) - len(lost)
    if recording.duration_s < SEGMENT_S:
        raise NoEstimateError(_too_short(0, n_sensors))
    names, segments = sensor_segments(recording, Welch(SEGMENT_S))
    there = _places(recording.manifest, generator.frame_sensor)
    places = [there.get(name) for name in names]
    order = [places.index(place) for place in generator.sensors if place not in lost]
    speeds = segment_speeds(recording, segments)
    groups = groups_to_read(speeds, settings.speed_tolerance, settings.min_speed_m_per_s)
    chosen = without_loud(segments, groups[0]) if groups else torch.zeros(0, dtype=torch.bool)
    n_chosen = int(chosen.sum())
    if not n_chosen or segments.welch.n_averages(n_chosen) <= n_sensors + 1:
        raise NoEstimateError(_too_short(n_chosen, n_sensors))
    bins = _bins(segments.frequencies_hz)
    matrix = SpectralMatrix.of(segments, chosen).at(bins).of_sensors(order)
    frequencies_hz, lines = segments.frequencies_hz[bins], wheel_lines(recording)
    return BogieTrip(
        frequencies_hz,
        matrix,
        float(speeds[chosen].mean()),
        direction or recording.manifest.direction or FORWARD,
        lost,
        line_bins(lines, speeds[chosen], frequencies_hz, SEGMENT_S) if lines else None,
    )


def _lost_sensors(recording: Recording, generator: SpatialVehicle) -> tuple[str, ...]:
    """Return the places of the generator's at which a recording has no living sensor.

    NoEstimateError if the sensors at its other places do not show the parts.
    """
    assert generator.sensors is not None
    places = _places(recording.manifest, generator.frame_sensor)
    living = {places.get(name) for name in recording.sensors()}
    kept = [place for place in generator.sensors if place in living]
    lost = tuple(place for place in generator.sensors if place not in living)
    if lost and not show_parts(kept):
        raise NoEstimateError(
            Finding(
                "sensors-lost-for-parts",
                lost=together(lost, ", "),
                sensors=together(generator.sensors, ", "),
                least_sensors=LEAST_SENSORS,
            )
        )
    return lost


def _too_short(n_segments: int, n_sensors: int) -> str:
    least = math.nextafter(n_sensors + 1, math.inf)  # more than one beyond the sensors
    return Finding(
        "too-short-for-parts",
        n_sensors=n_sensors,
        minutes_each=SEGMENT_S / 60,
        minutes=minutes_words(Welch(SEGMENT_S), n_segments, least),
    )


def sensor_places(
    manifest: TripManifest, frame_sensor: Literal["axle", "centre"]
) -> tuple[str, ...]:
    """Return the places of a trip's sensors, in the order of ``PLACES``.

    Sensors in between, such as the mean of two axle boxes, are left out. `frame_sensor` is where
    sensors on the frame at axle 1 really are.
    """
    found = set(_places(manifest, frame_sensor).values())
    return tuple(place for place in PLACES if place in found and place not in IN_BETWEEN)


def show_parts(places: Sequence[str]) -> bool:
    """Return whether sensors at these places show each part: more than inputs, on both sides."""
    sides = {place.rpartition("_")[2] for place in places}
    return len(places) >= LEAST_SENSORS and sides.issuperset(SIDES)


def estimate_parts(
    bogie: CommissionedBogie,
    recording: Recording,
    settings: TripSettings,
    direction: Direction | None = None,
) -> Estimate:
    """Return the ratio to healthy of each part on a trip, one row; `found` names the worn ones.

    NoEstimateError is raised as by `bogie_trip`, UnexplainedError if the vehicle does not explain
    the trip, TripError if two sensors look swapped.
    """
    trip = bogie_trip(recording, bogie.generator, settings, direction)
    if settings.check_channels:
        check_order(bogie.generator, trip)
    parts = fit_parts(bogie, trip, settings.level)
    most = LARGEST_MISFIT * max(1.0, bogie.misfit)
    if not parts.misfit <= most:  # also NaN
        furthest = COMPONENTS[int(np.argmax(np.abs(np.log(parts.values[:-1]))))]
        raise UnexplainedError(
            Finding(
                "parts-explain-nothing",
                misfit=parts.misfit,
                most=most,
                furthest=furthest,
                values=100 * parts.values[COMPONENTS.index(furthest)],
            )
        )
    found = parts.as_estimate()
    flags = with_bogie_doubt(found.flags, has_converged=bogie.converged, misfit=bogie.misfit)
    worn = together(one.finding for one in worn_parts(parts))
    places = _places(recording.manifest, bogie.generator.frame_sensor)
    names = {place: name for name, place in places.items()}
    estimate = replace(
        found,
        flags=flags,
        healthy=bogie.healthy,
        found=worn,
        misfit=parts.misfit,
        lost=tuple(names.get(place, place) for place in trip.lost),
    )
    if parts.converged:
        return estimate
    text = "the search for the parts did not end within its steps"
    return replace(estimate, flags=estimate.flags.with_kind("misfit", text))


def _places(manifest: TripManifest, frame_sensor: Literal["axle", "centre"]) -> dict[str, str]:
    """Return the place of each sensor by its name, such as "axle_box axle2 left"."""
    found = {}
    for name, one in manifest.sensors().items():
        axle = "axle2" if one.is_elsewhere else "axle1"
        frame = "centre" if frame_sensor == "centre" and not one.is_elsewhere else axle
        known = {"axle_box": f"axle_box_{axle}", "bogie": f"frame_{frame}", "body": "body"}
        found[name] = f"{known[name.split()[0]]}_{manifest.side_of(one) or MIDDLE}"
    return found


def _bins(frequencies_hz: Tensor) -> Tensor:
    """Return the numbers of the bins in use."""
    inside = (frequencies_hz >= LOW_HZ - 1e-9) & (frequencies_hz <= HIGH_HZ + 1e-9)
    found: Tensor = inside.nonzero()[:: round(SPACING_HZ * SEGMENT_S), 0]
    return found
