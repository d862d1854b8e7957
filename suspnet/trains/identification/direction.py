"""The direction of travel of a trip, and the methods for it."""

from collections.abc import Sequence
from dataclasses import replace

from suspnet.curves.welch import SegmentSpectra
from suspnet.estimation.fitted import FittedMethod
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import FORWARD, Direction, direction_words
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.sensors.plausibility import DIRECTION_MARGIN, shown_direction
from suspnet.trains.spectra.segments import segment_speeds
from suspnet.trains.spectra.steady_parts import groups_to_read
from suspnet.vehicle import ResponseGenerator


def of_direction(
    pairs: Sequence[tuple[FittedMethod, SegmentSpectra]],
    recording: Recording,
    settings: TripSettings,
) -> list[tuple[FittedMethod, SegmentSpectra]]:
    """Return the methods, with their segments, for the direction in which a trip was run.

    A single direction of all methods is assumed where the manifest gives none; `check_channels`
    compares it with the phases.
    """
    directions = {method.generator.direction for method, _ in pairs} - {None}
    direction = recording.manifest.direction
    if direction is None and len(directions) > 1:
        method, segments = pairs[0]
        direction = direction_of(recording, segments, method.generator, settings)
    chosen = [
        p for p in pairs if direction is None or p[0].generator.direction in (None, direction)
    ]
    if not chosen:
        raise TripError(
            Finding(
                "direction-of-models",
                direction_words=direction_words(direction),
                direction_words2=direction_words(directions.pop()),
            )
        )
    return chosen


def direction_of(
    recording: Recording,
    segments: SegmentSpectra,
    generator: ResponseGenerator,
    settings: TripSettings,
) -> Direction:
    """Return the direction in which a trip was run: as its manifest says, else by its phases.

    The phases are those of the largest group of segments at one speed. TripError is raised if they
    do not show the direction.
    """
    if recording.manifest.direction or generator.speed_m_per_s is None or not len(segments.values):
        return recording.manifest.direction or FORWARD
    if recording.absent:
        raise TripError.at(
            recording.manifest.path,
            "no-direction-without-sensor",
            absent=together(recording.absent, " and "),
        )
    speeds = segment_speeds(recording, segments)
    groups = groups_to_read(speeds, settings.speed_tolerance, settings.min_speed_m_per_s)
    if not groups:
        return FORWARD  # nothing is read of it
    at_speed = replace(generator, speed_m_per_s=float(speeds[groups[0]].mean()))
    spectra = segments.average(groups[0])
    direction, factor = shown_direction(spectra, segments.frequencies_hz, at_speed)
    if factor < DIRECTION_MARGIN:
        raise TripError.at(
            recording.manifest.path,
            "direction-unclear",
            direction_words=direction_words(direction),
            factor=factor,
        )
    return direction
