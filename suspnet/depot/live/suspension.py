"""One suspension in operation: its frames become sections, and each section a trip of its own."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path

import numpy as np

from suspnet.depot.live.journal import dump_state, load_state
from suspnet.depot.live.operating_conditions import SlowValues
from suspnet.depot.live.sections import LiveSettings, Sections
from suspnet.estimation.fitted import Model
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.findings import at
from suspnet.ground.records import TripResult
from suspnet.trains.jobs.fleet import FleetSettings
from suspnet.trains.recordings.dates import EPOCH, SECOND_NS
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.frames import MOST_CHARACTERS, Frame
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.recordings.running import Running
from suspnet.trains.trips.commissionings import models_of
from suspnet.trains.trips.grouping import find_groups
from suspnet.trains.trips.trip import evaluate_recording


@dataclass(frozen=True)
class Due:
    """A section whose estimate is due.

    `is_final`: the section has ended, or is reported as if it had. `mileage_km` is that at the
    section's start; None: the mileage at the end of the previous section.
    """

    section: Running
    is_final: bool
    mileage_km: float | None
    temperature_c: float | None


@dataclass(frozen=True)
class SectionEstimate:
    """The result of a section.

    `frames` are counts as in ``Assembler.counts``, over all sensors, with the "dropped" frames of
    ``Sections.counts``; `distance_km` was run in the section, 0 if unknown.
    """

    result: TripResult
    is_final: bool
    frames: dict[str, int]
    distance_km: float


@dataclass(frozen=True)
class EstimateJob:
    """An estimate that any thread can make: it is self-contained.

    `section` is that of `due`, or a copy of it if more frames may come.
    """

    due: Due
    section: Running
    manifest: TripManifest
    frames: dict[str, int]
    models: Sequence[Model]
    trips: TripSettings

    def make(self) -> SectionEstimate:
        """Return the estimate, or the reason why there is none; it never fails."""
        distance_km = 0.0

        def read() -> Recording:
            nonlocal distance_km
            recording = replace(self.section.recording(), manifest=self.manifest)
            distance_km = _distance_km(recording)
            return recording

        result = evaluate_recording(self.manifest, read, self.models, self.trips)
        return SectionEstimate(result, self.due.is_final, self.frames, distance_km)


class LiveSuspension:
    """Turns the frames of one suspension into estimates.

    Memory is that of `Sections`. The manifest's mileage applies to the first section, unless frames
    report it.
    """

    def __init__(
        self,
        manifest: TripManifest,
        models: Sequence[Model],
        trips: TripSettings,
        settings: LiveSettings,
    ) -> None:
        self.manifest, self.models = manifest, models
        self.name = str(manifest.place)
        self._trips, self._settings = trips, settings
        self._sections = Sections(manifest, settings, trips.rate_hz)
        self._slow = SlowValues(manifest.mileage_km, manifest.temperature_c)
        # key of the open section with interim estimates: number of `every_s` reported
        self._reported: dict[int, int] = {}
        # key of each section reported as if ended: its mileage [km] and number of frames
        self._silent: dict[int, tuple[float, int]] = {}

    def take(self, frame: Frame, is_known: bool = False) -> None:
        """Take a frame; FrameError if it is rejected as a whole, as in `Sections.add`."""
        if frame.sensor in SlowValues.UNITS:
            self._slow.take(frame)
        else:
            self._sections.add(frame, is_known)

    def due(self) -> list[Due]:
        """Return the estimates of sections that have ended or have run for another `every_s`.

        An ended section is returned once: it is no longer part of the state.
        """
        due = self._ended(self._sections.over())
        every_s = self._settings.every_s
        if every_s is None:
            return due
        for section in self._sections.growing[:1]:
            step = int(section.n_seconds / every_s)
            is_new = step > self._reported.get(section.zero_ns, 0)
            if is_new and step * every_s < self._settings.section_s:
                self._reported = {section.zero_ns: step}
                due.append(self._due(section, is_final=False))
        return due

    def silent(self) -> list[Due]:
        """Return the estimates of open sections with new frames, when frames have ceased."""
        due = []
        for section in self._sections.open:
            _, n_frames = self._silent.get(section.zero_ns, (0.0, 0))
            if _n_frames(section) > n_frames and not section.is_empty:
                due.append(self._due(section, is_final=True))
        return due

    def end(self) -> list[Due]:
        """Return the estimates of all sections: no more frames come."""
        return self._ended(self._sections.close())

    def job(self, due: Due) -> EstimateJob:
        """Return a due estimate together with what it needs of the present state.

        `finish` must get its result before the next job of this suspension is made.
        """
        section, mileage_km = due.section, due.mileage_km
        start = EPOCH + timedelta(seconds=section.begin_ns // SECOND_NS)
        if section.zero_ns in self._silent:
            # the store identifies the trip by this mileage, and replaces it only under the same
            mileage_km, _ = self._silent[section.zero_ns]
        manifest = replace(
            self.manifest,
            name=f"{start:%Y-%m-%d %H:%M}",
            start=start,
            mileage_km=self._slow.passed_km if mileage_km is None else mileage_km,
            temperature_c=due.temperature_c,
            truth={},
        )
        frames = Counter(self._sections.counts)
        for running in filter(None, (section, section.rest)):
            for counts in running.sensors.values():
                frames.update(counts)
        if due.is_final:
            self._sections.counts.clear()
        if section in self._sections.open:
            if due.is_final:
                self._silent[section.zero_ns] = manifest.mileage_km, _n_frames(section)
            section = copy.deepcopy(section)  # the main thread adds frames to the original
        return EstimateJob(due, section, manifest, dict(frames), self.models, self._trips)

    def finish(self, job: EstimateJob, estimate: SectionEstimate) -> None:
        """Advance the mileage by an ended section."""
        section = job.due.section
        had_ended = job.section is section  # when the job was made: an open section was copied
        if job.due.is_final and had_ended:
            end_km = estimate.result.mileage_km + estimate.distance_km
            self._slow.pass_section(_end_ns(section), end_km)
            self._silent.pop(section.zero_ns, None)

    def dump(self) -> bytes:
        """Return the state."""
        silent = {str(zero_ns): list(values) for zero_ns, values in self._silent.items()}
        state = {"sections": self._sections.state(), "slow": self._slow.state(), "silent": silent}
        return dump_state(self._identity, state)

    def load(self, content: bytes) -> None:
        """Restore a state; StateError if it is damaged or was made with other settings."""
        state = load_state(content, self._identity)
        self._sections.restore(state["sections"])
        self._slow.restore(state["slow"])
        self._silent = {int(zero_ns): (km, n) for zero_ns, (km, n) in state["silent"].items()}

    @property
    def _identity(self) -> list[object]:
        return [self.name, self._sections.identity]

    def _ended(self, sections: Sequence[Running]) -> list[Due]:
        # a section without acceleration is only the last speed of a trip: nothing to report
        return [self._due(section, is_final=True) for section in sections if not section.is_empty]

    def _due(self, section: Running, is_final: bool) -> Due:
        # mileage and temperature are looked up now, so that the time of the job does not matter
        begin_ns = section.begin_ns // SECOND_NS * SECOND_NS
        before_ns = 0 if section.goes_on else round(self._settings.pause_s * SECOND_NS)
        return Due(section, is_final, *self._slow.within(begin_ns, _end_ns(section), before_ns))


def _end_ns(section: Running) -> int:
    return max(section.end_ns, 0 if section.rest is None else section.rest.end_ns)


def _n_frames(section: Running) -> int:
    return section.n_frames + (0 if section.rest is None else section.rest.n_frames)


def _distance_km(recording: Recording) -> float:
    """Return the distance run [km]; unknown speeds count as the mean of the known ones."""
    speeds = recording.speed_m_per_s[np.isfinite(recording.speed_m_per_s)]
    return float(speeds.mean()) * recording.duration_s / 1000 if len(speeds) else 0.0


def read_suspensions(
    folder: Path, models: Sequence[Model], settings: FleetSettings, live: LiveSettings
) -> list[LiveSuspension]:
    """Return each suspension that a folder has manifests of; data files may be missing.

    `folder` is as for `evaluate_fleet`. FileNotFoundError is raised if there is no manifest;
    TripError if a manifest is faulty, is of another vehicle, lacks the unit of a sensor's range, or
    has a name that frames cannot have; ModelFileError if a suspension has no model, or the limits
    do not go together.
    """
    suspensions = []
    for group in find_groups(folder):
        if group.error:
            raise TripError(f"{group.folder}: {group.error}")
        # the newest trip; a manifest without a mileage, NaN, comes before all others
        trips = (file.live_trip for file in group.manifests)
        manifest = max(trips, key=lambda trip: np.nan_to_num(trip.mileage_km, nan=-1.0))
        name = str(manifest.place)
        if not name.isprintable() or len(name) > MOST_CHARACTERS:
            raise TripError(
                f"{manifest.path}: frames cannot name the suspension {name[:80]!r}; a name is "
                f"plain text of at most {MOST_CHARACTERS} characters"
            )
        own_models = models_of(models, group.place)
        settings.limits_of(own_models)
        if (vehicle := own_models[0].vehicle.name) != manifest.vehicle:
            names = {"vehicle": repr(manifest.vehicle), "vehicle2": repr(vehicle)}
            raise TripError(at(manifest.path, "stream-of-other-vehicle", **names))
        # a train runs both ways: the direction of that trip is not that of the next
        manifest = replace(manifest, direction=None)
        suspensions.append(LiveSuspension(manifest, own_models, settings.trips, live))
    return suspensions
