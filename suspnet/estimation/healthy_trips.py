"""Healthy trips of a folder: from recordings to spectra at each speed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from suspnet.estimation.from_recording import TripSettings, steady, unrepaired_words
from suspnet.estimation.steady_parts import groups_to_read
from suspnet.ground.parameters import FORWARD, Direction
from suspnet.ground.progress import bar
from suspnet.recordings.manifest import TripManifest
from suspnet.recordings.manifest_files import ManifestFile, find_manifests
from suspnet.recordings.manifest_keys import TripError
from suspnet.recordings.recording import Recording, load_recording
from suspnet.spectra.cross_spectra import CrossSpectra
from suspnet.spectra.estimates import EstimateSettings
from suspnet.spectra.segments import recording_segments, segment_speeds
from suspnet.spectra.speeds import Speeds

LEAST_TRIPS = 3
"""Smallest number of healthy trips; fewer contain too little information on a vehicle."""


@dataclass(frozen=True)
class HealthySpectra:
    """Spectra of one healthy trip at one speed.

    `trip` is the index of the trip, which has one car-body mass and one direction; `speeds` are
    those of the segments behind the spectra, (3, n_freq) on the bins of the settings.
    """

    trip: int
    name: str
    speeds: Speeds
    spectra: CrossSpectra
    direction: Direction = FORWARD

    @property
    def speed_m_per_s(self) -> float:
        """Mean speed, [m/s]."""
        pairs = zip(self.speeds.m_per_s, self.speeds.weights, strict=True)
        return sum(speed * weight for speed, weight in pairs)


@dataclass(frozen=True)
class HealthyTrips:
    """Spectra of the healthy trips of one suspension.

    Attributes
    ----------
    manifests : tuple of TripManifest
        Those of the trips in use.
    groups : tuple of HealthySpectra
    paired : tuple of 3 bool
        Which of axle box, frame and body have a sensor left and right.
    left_out : tuple of str
        Trips without a usable stretch, with the reason.
    """

    manifests: tuple[TripManifest, ...]
    groups: tuple[HealthySpectra, ...]
    paired: tuple[bool, bool, bool]
    left_out: tuple[str, ...] = ()


def read_healthy(
    folder: Path,
    vehicle: str,
    settings: EstimateSettings,
    trips: TripSettings,
    *,
    bogie: str | None = None,
    paths: Sequence[ManifestFile] | None = None,
    n_first: int | None = None,
    progress: bool = False,
) -> HealthyTrips:
    """Return the spectra of a folder's healthy trips.

    Parameters
    ----------
    folder : Path
        Holds a manifest for each trip of one suspension.
    vehicle : str
        The vehicle that the manifests must name.
    settings : EstimateSettings
        Bound to the vehicle: bins and window.
    trips : TripSettings
        How trips are read.
    bogie : {"leading", "trailing"}, optional
        The bogie that manifests must name, if they name one; None is any.
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
    manifests = [one.trip for one in paths or map(ManifestFile, find_manifests(folder))]
    manifests.sort(key=lambda manifest: manifest.mileage_km)
    manifests = manifests[:n_first]
    _check_same(folder, manifests, vehicle, bogie)
    # a trip without a usable stretch is left out, with the reason
    kept: list[TripManifest] = []
    groups: list[HealthySpectra] = []
    paired: set[tuple[bool, bool, bool]] = set()
    left_out = []
    for manifest in bar("healthy trips", items=manifests, unit="trip", shown=progress):
        recording = load_recording(manifest, trips.rate_hz)
        found = _spectra(recording, len(kept), manifest.name, settings, trips)
        if not found:
            words = f"{manifest.name}: no stretch at one speed is long enough and free of faults"
            left_out.append(": ".join(filter(None, [words, unrepaired_words(recording)])))
            continue
        kept.append(replace(manifest, start=manifest.start or recording.started))
        groups += found
        paired.add(recording.paired)
    # the remaining trips must be enough, and of the same sensors
    if len(kept) < LEAST_TRIPS:
        reasons = f" ({'; '.join(left_out)})" if left_out else ""
        raise TripError(
            f"{folder}: {len(kept)} healthy trips can be used, at least {LEAST_TRIPS} are needed "
            f"to commission a vehicle{reasons}"
        )
    if len(paired) > 1:
        raise TripError(
            f"{folder}: some healthy trips have sensors left and right where others have one; "
            "commission on trips with the same sensors"
        )
    return HealthyTrips(tuple(kept), tuple(groups), paired.pop(), tuple(left_out))


def _check_same(
    folder: Path, manifests: Sequence[TripManifest], vehicle: str, bogie: str | None
) -> None:
    """Raise TripError unless all manifests are of one suspension of the vehicle."""
    for manifest in manifests:
        if manifest.vehicle != vehicle:
            raise TripError(
                f"{manifest.path}: the trip is of vehicle {manifest.vehicle!r}, vehicle={vehicle} "
                "is to be commissioned"
            )
    places = sorted({str(manifest.place) for manifest in manifests})
    if len(places) > 1:
        raise TripError(
            f"{folder}: the trips are of several suspensions ({', '.join(places)}); each is "
            "commissioned on trips of its own: give a folder of one"
        )
    named = manifests[0].place.bogie
    if named and bogie not in (None, named):
        raise TripError(
            f"{folder}: the trips are of the {named} bogie, the model would be of the {bogie} one: "
            f"give generator.bogie={named}"
        )


def _spectra(
    recording: Recording, trip: int, name: str, settings: EstimateSettings, trips: TripSettings
) -> list[HealthySpectra]:
    segments = recording_segments(recording, settings.welch)
    if not len(segments.values):
        return []
    speeds = segment_speeds(recording, segments)
    groups = groups_to_read(speeds, trips.speed_tolerance, trips.min_speed_m_per_s)
    # uncertain groups are included, as the fit of the vehicle weights each by its noise
    return [
        HealthySpectra(trip, name, Speeds.of(*part.speed), part.found.spectra)
        for part in steady(segments, speeds, groups, settings, trips)
        if part.found.spectra is not None and part.has_enough
    ]
