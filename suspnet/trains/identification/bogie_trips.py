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
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import FORWARD, Direction
from suspnet.trains.fits.bogie_fit import fit_parts
from suspnet.trains.fits.worn_parts import worn_parts
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_sources import MIDDLE
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.sensors.swapped_sensors import check_order
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.segments import (
    evened_segments,
    segment_speeds,
    sensor_segments,
    without_loud,
)
from suspnet.trains.spectra.steady_parts import groups_to_read, minutes_words
from suspnet.trains.spectra.subspace import SpectralMatrix
from suspnet.trains.spectra.wheel_lines import line_bins, wheel_lines
from suspnet.vehicle import SpatialVehicle, VerticalVehicle
from suspnet.vehicle.quantities import ADDITIONS, IN_BETWEEN, LEAST_SENSORS, PLACES, show_parts

PARTS_OF_BOGIE = (
    *("bushings", "rubber", "guidance", "longitudinal", "bending", "payload", "sensors"),
    *("frame_sway", "frame_yaw", "body_yaw", "creep", "torsion", "yaw_dampers"),
)
"""What a vehicle whose parts are read may have besides rigid bodies on springs and dampers."""
EQUAL_PARTS = tuple(part for part in PARTS_OF_BOGIE if part not in ADDITIONS)
"""What a vehicle may have whose sensors do not show each part: nothing moves to the side but the
body, and all parts of a kind wear alike."""
SHARED = ("bogie", "axle", "frame_sensor", "body_sensor_m", "nominal")
"""Settings that it shares with the vehicle of both sides as equal."""
SEGMENTS_S = (120.0, 60.0)
"""Lengths of segments, of which the first that gives enough averages is taken: the shorter a
segment, the more of a bin is leaked by its neighbours."""
N_BINS = 5
"""Neighbouring bins whose spectra are averaged. With 1 the errors of the parts of twelve trips are
1.1 to 1.9 times as large (k_p, c_s; benchmarks/rough_train.py, family, seed 0)."""
AVERAGES_OF_SENSOR = 2
"""Independent averages a sensor that a trip must exceed: its noise is estimated from them."""
UNLIKE_HEALTHY = 3.0
"""Misfit of a trip, over noise and errors that the healthy trips show, from which it is flagged:
something else than springs and dampers has changed."""
LOW_HZ, HIGH_HZ = 0.5, 18.0
"""Ends of the band: below, accelerometers drift; above, frame and body have modes of their own."""
MAINS_HZ, HUM_BINS = (16.5, 16.83), 3
"""Frequencies of railway mains, whose hum no vehicle explains, a third of a grid's that may be 1 %
off 50 Hz (IEC 60850), and the reach of its leakage in bins of a segment."""
SPACING_HZ, FEW_SPACING_HZ = 0.1, 0.05
"""Distance of the bins that are read, far enough for them to be independent. Few sensors need
all data of a trip: 6 bins of its longest segments, of which 5 are averaged."""


def bogie_vehicle(
    manifests: Sequence[TripManifest], generator: VerticalVehicle
) -> SpatialVehicle | None:
    """Return the vehicle, with its prior, that the sensors of some trips show.

    `generator` gives vehicle and bogie, the manifests give the places of sensors. Where these do
    not show each part, all of a kind are equal. None if there is no sensor on axle box, frame or
    body then; TripError if the trips' sensors differ.
    """
    places = [sensor_places(manifest, generator.frame_sensor) for manifest in manifests]
    separate = any(map(show_parts, places))
    if not separate:
        places = [_placed(manifest, generator.frame_sensor) for manifest in manifests]
        if not all(len({place.split("_")[0] for place in of_trip}) == 3 for of_trip in places):
            return None
    if len(set(places)) > 1:
        raise TripError.at(manifests[0].path.parent, "sensors-differ-healthy")
    lateral_m = [abs(lateral_m) or 1.0 for lateral_m in generator.sensor_lateral_m]
    vehicle = SpatialVehicle(
        generator.vehicle,
        **{name: getattr(generator, name) for name in SHARED},
        parts=PARTS_OF_BOGIE if separate else generator.parts or EQUAL_PARTS,
        sensor_lateral_m=(lateral_m[0], lateral_m[1], lateral_m[2]),
        sensors=places[0],
    )
    return vehicle.seen_prior()


def bogie_trip(
    recording: Recording,
    generator: SpatialVehicle,
    settings: TripSettings | None = None,
    direction: Direction | None = None,
) -> BogieTrip:
    """Return the spectral matrix of a recording's largest stretch at one speed.

    If sensors of the generator's are missing or dead, or one whose faults leave no long stretch, it
    is that of the others (`lost` of the result). Bins with lines of out-of-round wheels of axle 1,
    and with hum of about 16.7 Hz, are left out.

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
        stretch at one speed is long enough for twice as many averages as sensors, also without the
        sensor whose faults break it up the most.
    """
    settings = settings or TripSettings()
    candidates, reasons = _candidates(recording), []
    for segment_s in SEGMENTS_S:
        for candidate in candidates:
            try:
                return _trip_of_all(candidate, generator, settings, direction, segment_s)
            except NoEstimateError as reason:
                reasons.append(reason)
    raise reasons[-len(candidates)]  # of all sensors, with the shortest segments


def _candidates(recording: Recording) -> list[Recording]:
    """Return a recording, and without the sensor whose faults break it up the most, if any does."""
    if not recording.faulty:
        return [recording]
    worst = max(recording.faulty, key=lambda name: int(recording.faulty[name].sum()))
    return [recording, recording.without(worst)]


def _trip_of_all(
    recording: Recording,
    generator: SpatialVehicle,
    settings: TripSettings,
    direction: Direction | None,
    segment_s: float,
) -> BogieTrip:
    """Return the spectral matrix of all sensors of a recording, as of `bogie_trip`."""
    lost = _lost_sensors(recording, generator)
    n_sensors = len(generator.places) - len(lost)
    # the most bins, in a band about each one that is read, that do not reach into the next band
    is_few = len(generator.places) < LEAST_SENSORS
    every = round((FEW_SPACING_HZ if is_few else SPACING_HZ) * segment_s)
    n_bins = min(N_BINS, every - (every + 1) % 2)
    if recording.duration_s < segment_s:
        raise NoEstimateError(_too_short(0, n_sensors, segment_s, n_bins))
    if is_few:
        names, segments = sensor_segments(recording, Welch(segment_s))
        levels = torch.zeros(len(segments.first))
    else:
        names, segments, levels = evened_segments(recording, Welch(segment_s))
    place_of = _places(recording.manifest, generator.frame_sensor)
    places = [place_of.get(name) for name in names]
    order = [places.index(place) for place in generator.places if place not in lost]
    speeds = segment_speeds(recording, segments)
    groups = groups_to_read(speeds, settings.speed_tolerance, settings.min_speed_m_per_s)
    chosen = without_loud(segments, groups[0]) if groups else torch.zeros(0, dtype=torch.bool)
    n_chosen = int(chosen.sum())
    least = AVERAGES_OF_SENSOR * n_sensors
    if not n_chosen or segments.welch.n_averages(n_chosen, n_bins) <= least:
        raise NoEstimateError(_too_short(n_chosen, n_sensors, segment_s, n_bins))
    bins = _bins(segments.frequencies_hz, every)
    matrix = SpectralMatrix.of(segments, chosen, n_bins).at(bins).of_sensors(order)
    # scaled to the mean log level of the chosen segments
    matrix = replace(matrix, values=matrix.values * torch.exp(2 * levels[chosen].mean()))
    frequencies_hz, lines = segments.frequencies_hz[bins], wheel_lines(recording)
    (low_hz, high_hz), reach_hz = MAINS_HZ, (HUM_BINS + n_bins // 2) / segment_s
    left_out = (frequencies_hz >= low_hz - reach_hz) & (frequencies_hz <= high_hz + reach_hz)
    left_out |= line_bins(lines, speeds[chosen], frequencies_hz, segment_s, n_bins)
    return BogieTrip(
        frequencies_hz,
        matrix,
        float(speeds[chosen].mean()),
        direction or recording.manifest.direction or FORWARD,
        lost,
        left_out,
        segments.welch,
        n_bins,
        0.0 if is_few else float(speeds[chosen].std(correction=0) / speeds[chosen].mean()),
    )


def _lost_sensors(recording: Recording, generator: SpatialVehicle) -> tuple[str, ...]:
    """Return the places of the generator's at which a recording has no living sensor.

    NoEstimateError if the sensors at its other places do not show the parts, or one is missing
    where no sensors show them.
    """
    places = _places(recording.manifest, generator.frame_sensor)
    living = {places.get(name) for name in recording.sensors()}
    present = [place for place in generator.places if place in living]
    lost = tuple(place for place in generator.places if place not in living)
    if lost and not show_parts(present):
        raise NoEstimateError(
            Finding(
                "sensors-lost-for-parts" if generator.shows_parts else "sensors-lost",
                lost=together(lost, ", "),
                sensors=together(generator.places, ", "),
                least_sensors=LEAST_SENSORS,
            )
        )
    return lost


def _too_short(n_segments: int, n_sensors: int, segment_s: float, n_bins: int) -> str:
    least = math.nextafter(AVERAGES_OF_SENSOR * n_sensors, math.inf)
    return Finding(
        "too-short-for-parts",
        n_sensors=n_sensors,
        seconds_each=segment_s,
        minutes=minutes_words(Welch(segment_s), n_segments, least, n_bins),
    )


def sensor_places(
    manifest: TripManifest, frame_sensor: Literal["axle", "centre"]
) -> tuple[str, ...]:
    """Return the places of a trip's sensors, in the order of ``PLACES``.

    Sensors in between, such as the mean of two axle boxes, are left out. `frame_sensor` is where
    sensors on the frame at axle 1 really are.
    """
    return tuple(p for p in _placed(manifest, frame_sensor) if p not in IN_BETWEEN)


def _placed(manifest: TripManifest, frame_sensor: Literal["axle", "centre"]) -> tuple[str, ...]:
    """Return the places of all sensors of a trip, axle boxes first, in the order of ``PLACES``."""
    places = set(_places(manifest, frame_sensor).values())
    kinds = "axle_box", "frame", "body"
    return tuple(p for kind in kinds for p in PLACES if p.startswith(kind) and p in places)


def estimate_parts(
    bogie: CommissionedBogie,
    recording: Recording,
    settings: TripSettings,
    direction: Direction | None = None,
) -> Estimate:
    """Return the ratio to healthy of each part on a trip, one row; `found` names the worn ones.

    Where the sensors do not show each part, it is that of all parts of a kind. Damping is as under
    the conditions of the healthy trips. The estimate is flagged if the trip is unlike the healthy
    ones. NoEstimateError is raised as by `bogie_trip`, TripError if two sensors look swapped.
    """
    trip = bogie_trip(recording, bogie.generator, settings, direction)
    if settings.check_channels:
        check_order(bogie.generator, trip)
    celsius = recording.manifest.temperature_c
    parts = fit_parts(bogie, trip, settings.level, temperature_c=celsius)
    estimate = parts.as_estimate()
    flags = estimate.flags
    if not bogie.converged:
        flags = flags.with_kind("physics", Finding("healthy-search-unfinished"))
    if not parts.converged:
        flags = flags.with_kind("misfit", "the search for the parts did not end within its steps")
    # its covariance grows with the misfit, so that none alone silences a verdict
    worn = ""
    if bogie.generator.shows_parts and np.isfinite(parts.misfit):
        worn = together(part.finding for part in worn_parts(parts))
    if not parts.misfit <= UNLIKE_HEALTHY:  # also NaN
        flags = flags.with_kind("misfit", Finding("unlike-healthy", misfit=parts.misfit))
    places = _places(recording.manifest, bogie.generator.frame_sensor)
    names = {place: name for name, place in places.items()}
    return replace(
        estimate,
        flags=flags,
        healthy=bogie.healthy,
        found=worn,
        misfit=parts.misfit,
        lost=tuple(names.get(place, place) for place in trip.lost),
    )


def _places(manifest: TripManifest, frame_sensor: Literal["axle", "centre"]) -> dict[str, str]:
    """Return the place of each sensor by its name, such as "axle_box axle2 left"."""
    places = {}
    for name, sensor in manifest.sensors().items():
        axle = "axle2" if sensor.is_elsewhere else "axle1"
        frame = "centre" if frame_sensor == "centre" and not sensor.is_elsewhere else axle
        along = {"axle_box": f"axle_box_{axle}", "bogie": f"frame_{frame}", "body": "body"}
        places[name] = f"{along[name.split()[0]]}_{manifest.side_of(sensor) or MIDDLE}"
    return places


def _bins(frequencies_hz: Tensor, every: int) -> Tensor:
    """Return the numbers of the bins in use, which are the same for all lengths of segments."""
    inside = (frequencies_hz >= LOW_HZ - 1e-9) & (frequencies_hz <= HIGH_HZ + 1e-9)
    numbers: Tensor = inside.nonzero()[::every, 0]
    return numbers
