"""Healthy trips of a folder, as a commissioning reads them."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.speeds import NoEstimateError, Speeds
from suspnet.curves.welch import SegmentSpectra
from suspnet.estimation.trip_settings import LEAST_TRIPS, TripSettings
from suspnet.ground.findings import Finding, of, together
from suspnet.ground.parameters import REVERSE, Direction
from suspnet.ground.progress import bar
from suspnet.ground.tensors import threads
from suspnet.ground.wording import ShortRepr
from suspnet.trains.fits.healthy_misfit import HealthySpectra
from suspnet.trains.identification.bogie_trips import bogie_trip, bogie_vehicle
from suspnet.trains.identification.direction import direction_of
from suspnet.trains.identification.from_recording import no_channel, unrepaired_words
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_files import ManifestFile, find_manifests
from suspnet.trains.recordings.recording import Recording, load_recording
from suspnet.trains.sensors.swapped_sensors import Elsewhere, elsewhere
from suspnet.trains.spectra.bogie_trip import BogieTrip
from suspnet.trains.spectra.segments import recording_segments, segment_speeds
from suspnet.trains.spectra.steady_parts import groups_to_read, steady
from suspnet.trains.spectra.wheel_lines import wheel_lines
from suspnet.vehicle import SpatialVehicle, VerticalVehicle


@dataclass(frozen=True, repr=False)
class HealthyTrips(ShortRepr):
    """Healthy trips of one suspension.

    `manifests` are those of the trips in use; `vehicle` is the one with the parts that the sensors
    show, and `of_parts` are the trips as it reads them. `paired` tells which of axle box, frame and
    body have a sensor left and right, `absent` whether one of them has none at axle 1. `left_out`
    are trips without a usable stretch, with the reason; `doubts` are sentences on sensors that look
    to be elsewhere, and on the direction of travel.
    """

    manifests: tuple[TripManifest, ...]
    vehicle: SpatialVehicle
    of_parts: tuple[BogieTrip, ...]
    paired: tuple[bool, bool, bool]
    absent: bool = False
    left_out: tuple[str, ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def speeds_m_per_s(self) -> tuple[float, ...]:
        """Speeds of the stretches in use, [m/s]."""
        return tuple(trip.speed_m_per_s for trip in self.of_parts)


@threads(1)  # spectra are products of many small matrices
def read_healthy(
    folder: Path,
    generator: VerticalVehicle,
    settings: EstimateSettings,
    trips: TripSettings,
    *,
    paths: Sequence[ManifestFile] | None = None,
    n_first: int | None = None,
    progress: bool = False,
) -> HealthyTrips:
    """Return a folder's healthy trips.

    Parameters
    ----------
    folder : Path
        Holds a manifest for each trip of one suspension.
    generator : VerticalVehicle
        The vehicle and the bogie that the manifests must name, if they name a bogie.
    settings : EstimateSettings
        Bound to the vehicle: bins and window.
    trips : TripSettings
        How trips are read.
    paths : sequence of ManifestFile, optional
        Manifests to read, if the folder holds others as well; None is all.
    n_first : int, optional
        Use only the first trips by mileage.
    progress : bool
        Show a progress bar.

    Raises
    ------
    FileNotFoundError
        If there is no such folder, or no manifest in it.
    TripError
        If the trips are of another vehicle or bogie, of several suspensions or of different
        sensors, if a recording is faulty, or if fewer than three trips have a usable stretch.
    """
    manifests = [file.trip for file in paths or map(ManifestFile, find_manifests(folder))]
    manifests.sort(key=lambda manifest: manifest.mileage_km)
    manifests = manifests[:n_first]
    _check_same(folder, manifests, generator)
    vehicle = bogie_vehicle(manifests, generator)
    # a trip without a usable stretch is left out, with the reason
    usable: list[_ReadTrip] = []
    left_out = []
    for manifest in bar("healthy trips", items=manifests, unit="trip", shown=progress):
        try:
            usable.append(_read_one(manifest, generator, vehicle, settings, trips))
        except NoEstimateError as reason:
            left_out.append(of(manifest.name, str(reason)))
    # the remaining trips must be enough, and of the same sensors
    if len(usable) < LEAST_TRIPS:
        kind = "too-few-healthy-as" if left_out else "too-few-healthy"
        numbers = {"n": len(usable), "least": LEAST_TRIPS, "reasons": together(left_out)}
        raise TripError.at(folder, kind, **numbers)
    paired = {trip.paired for trip in usable}
    if len(paired) > 1:
        raise TripError.at(folder, "pairs-and-single-sensors")
    assert vehicle is not None  # else a trip that lacks a channel was refused
    return HealthyTrips(
        tuple(trip.manifest for trip in usable),
        vehicle,
        tuple(trip.of_parts for trip in usable),
        paired.pop(),
        any(trip.absent for trip in usable),
        tuple(left_out),
        tuple(_doubts(usable, generator)),
    )


@dataclass(frozen=True)
class _ReadTrip:
    """A healthy trip; `paired` and `absent` are as in ``HealthyTrips``.

    `elsewhere` is where its sensors look to be, None where the manifest says; `of_parts` is the
    trip as its parts are read.
    """

    manifest: TripManifest
    paired: tuple[bool, bool, bool]
    absent: bool
    elsewhere: Elsewhere | None
    of_parts: BogieTrip


def _read_one(
    manifest: TripManifest,
    generator: VerticalVehicle,
    vehicle: SpatialVehicle | None,
    settings: EstimateSettings,
    trips: TripSettings,
) -> _ReadTrip:
    """Return a healthy trip; NoEstimateError if it has no usable stretch."""
    recording = load_recording(manifest, trips.rate_hz)
    if recording.dead:
        faults = [str(fault) for fault in recording.faults if fault.channel in recording.dead]
        raise NoEstimateError(together(faults, ": "))
    if vehicle is None:
        raise TripError(of(manifest.path, no_channel(recording)))
    segments = recording_segments(recording, settings.welch)
    spectra = other = None
    if not recording.absent:
        spectra = _spectra(recording, segments, settings, trips)
        if spectra is not None and trips.check_channels:
            other = elsewhere(generator, settings, spectra, manifest.direction)
    # phases show the direction only with the sensors in their places
    placed = generator if other is None else other.best.vehicle
    direction = direction_of(recording, segments, placed, trips)
    if spectra is None and not recording.absent:
        reason = together((Finding("no-steady-stretch"), unrepaired_words(recording)), ": ")
        raise NoEstimateError(reason)
    return _ReadTrip(
        replace(manifest, start=manifest.start or recording.started),
        recording.paired,
        bool(recording.absent),
        other,
        trip_of_all_sensors(recording, vehicle, trips, direction),
    )


def _doubts(trips: Sequence[_ReadTrip], generator: VerticalVehicle) -> list[str]:
    """Return sentences on trips that look measured elsewhere, and on trips all run in reverse."""
    doubts: list[str] = []
    others = [trip.elsewhere for trip in trips if trip.elsewhere is not None]
    for change, n in Counter(other.change for other in others).most_common(1):
        if 2 * n > len(trips):  # one trip alone may be at fault
            first = next(other for other in others if other.change == change)
            doubts.append(
                Finding("on-some-healthy-trips", n=n, n_others=len(trips), first=str(first))
            )
    is_shown = all(trip.manifest.direction is None for trip in trips)
    if is_shown and all(trip.of_parts.direction == REVERSE for trip in trips):
        doubts.append(
            Finding(
                "all-in-reverse",
                n_others=len(trips),
                axle=generator.axle,
                bogie=generator.bogie,
                frame_sensor=generator.frame_sensor,
            )
        )
    return doubts


OTHER = {"bogie": "other-bogie", "axle": "other-axle"}
"""Kinds of what is found where trips are of the other bogie or axle."""


def _check_same(
    folder: Path, manifests: Sequence[TripManifest], generator: VerticalVehicle
) -> None:
    """Raise TripError unless all manifests are of one suspension of the vehicle."""
    vehicle = generator.vehicle.name
    for manifest in manifests:
        if manifest.vehicle != vehicle:
            raise TripError.at(
                manifest.path,
                "of-another-vehicle",
                vehicle=repr(manifest.vehicle),
                vehicle2=vehicle,
            )
    places = sorted({str(manifest.place) for manifest in manifests})
    if len(places) > 1:
        raise TripError.at(folder, "several-suspensions", places=together(places, ", "))
    for key, ours in (("bogie", generator.bogie), ("axle", generator.axle)):
        for named in {getattr(manifest, key) for manifest in manifests} - {None, ours}:
            raise TripError.at(folder, OTHER[key], named=named, own=ours)


def trip_of_all_sensors(
    recording: Recording, vehicle: SpatialVehicle, trips: TripSettings, direction: Direction
) -> BogieTrip:
    """Return a trip as its parts are read; NoEstimateError if it is too short for all sensors."""
    trip = bogie_trip(recording, vehicle, trips, direction)
    if trip.lost:
        raise NoEstimateError(
            Finding("no-stretch-of-all-sensors", unrepaired_words=unrepaired_words(recording))
        )
    return trip


def _spectra(
    recording: Recording, segments: SegmentSpectra, settings: EstimateSettings, trips: TripSettings
) -> HealthySpectra | None:
    """Return the spectra of a trip's largest usable stretch at one speed, if there is any."""
    if not len(segments.values):
        return None
    speeds = segment_speeds(recording, segments)
    groups = groups_to_read(speeds, trips.speed_tolerance, trips.min_speed_m_per_s)
    for part in steady(segments, speeds, groups, settings, trips, wheel_lines(recording)):
        if part.spectra is not None and part.has_enough:
            speed = Speeds.of(*part.speed)
            return HealthySpectra(speed, part.spectra, left_out=part.left_out)
    return None
