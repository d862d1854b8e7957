"""One suspension in operation: its frames become sections, and each section a trip of its own."""

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
class SectionEstimate:
    """The result of a section.

    `frames` are counts as in ``Assembler.counts``, over all sensors, with the "dropped" frames of
    ``Sections.counts``; `distance_km` was run in the section, 0 if unknown.
    """

    result: TripResult
    frames: dict[str, int]
    distance_km: float


@dataclass
class EstimateJob:
    """The estimate of a section that has ended; any thread can make it.

    `mileage_km` is that at the section's start; None until `LiveSuspension.begin` if only the end
    of the previous section tells it.
    """

    section: Running
    manifest: TripManifest
    mileage_km: float | None
    frames: dict[str, int]
    models: Sequence[Model]
    trips: TripSettings

    def make(self) -> SectionEstimate:
        """Return the estimate, or the reason why there is none; it never fails."""
        assert self.mileage_km is not None
        manifest, distance_km = replace(self.manifest, mileage_km=self.mileage_km), 0.0

        def read() -> Recording:
            nonlocal distance_km
            recording = replace(self.section.recording(), manifest=manifest)
            # unknown speeds count as the mean of the known ones
            speeds = recording.speed_m_per_s[np.isfinite(recording.speed_m_per_s)]
            if len(speeds):
                distance_km = float(speeds.mean()) * recording.duration_s / 1000
            return recording

        result = evaluate_recording(manifest, read, self.models, self.trips)
        return SectionEstimate(result, self.frames, distance_km)


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
        self._trips = trips
        self._pause_ns = round(settings.pause_s * SECOND_NS)
        self._sections = Sections(manifest, settings, trips.rate_hz)
        self._slow = SlowValues(manifest.mileage_km, manifest.temperature_c)

    def take(self, frame: Frame, is_known: bool = False) -> None:
        """Take a frame; FrameError if it is rejected as a whole, as in `Sections.add`."""
        if frame.sensor in SlowValues.UNITS:
            self._slow.take(frame)
        else:
            self._sections.add(frame, is_known)

    def due(self) -> list[EstimateJob]:
        """Return the estimates of sections that have ended; the state no longer holds these."""
        return self._jobs(self._sections.over())

    def end(self) -> list[EstimateJob]:
        """End all sections, as no more frames come, and return their estimates."""
        return self._jobs(self._sections.close())

    def begin(self, job: EstimateJob) -> None:
        """Complete a job; `finish` got the previous one of this suspension before."""
        if job.mileage_km is None:
            job.mileage_km = self._slow.passed_km

    def finish(self, job: EstimateJob, estimate: SectionEstimate) -> None:
        """Advance the mileage by a section."""
        end_km = estimate.result.mileage_km + estimate.distance_km
        self._slow.pass_section(job.section.end_ns, end_km)

    def dump(self) -> bytes:
        """Return the state."""
        state = {"sections": self._sections.state(), "slow": self._slow.state()}
        return dump_state(self._identity, state)

    def load(self, content: bytes) -> None:
        """Restore a state; StateError if it is damaged or was made with other settings."""
        state = load_state(content, self._identity)
        self._sections.restore(state["sections"])
        self._slow.restore(state["slow"])

    @property
    def _identity(self) -> list[object]:
        return [self.name, self._sections.identity]

    def _jobs(self, sections: Sequence[Running]) -> list[EstimateJob]:
        # a section without acceleration is only the last speed of a trip: nothing to report
        return [self._job(section) for section in sections if not section.is_empty]

    def _job(self, section: Running) -> EstimateJob:
        start = EPOCH + timedelta(seconds=section.begin_ns // SECOND_NS)
        # mileage and temperature are looked up now, so that the time of the job does not matter
        begin_ns = section.begin_ns // SECOND_NS * SECOND_NS
        before_ns = 0 if section.goes_on else self._pause_ns
        mileage_km, temperature_c = self._slow.within(begin_ns, section.end_ns, before_ns)
        manifest = replace(self.manifest, name=f"{start:%Y-%m-%d %H:%M}", start=start, truth={})
        manifest = replace(manifest, temperature_c=temperature_c)
        frames = Counter(self._sections.counts)
        self._sections.counts.clear()
        for counts in section.sensors.values():
            frames.update(counts)
        return EstimateJob(section, manifest, mileage_km, dict(frames), self.models, self._trips)


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
            names = {"vehicle": repr(manifest.vehicle), "name": repr(vehicle)}
            raise TripError.at(manifest.path, "model-of-other-vehicle", **names)
        # a train runs both ways: the direction of that trip is not that of the next
        manifest = replace(manifest, direction=None)
        suspensions.append(LiveSuspension(manifest, own_models, settings.trips, live))
    return suspensions
