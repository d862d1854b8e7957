"""The suspensions that a monitor knows, from a folder of manifests."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from suspnet.estimation.trained import TrainedModel
from suspnet.live.suspension import LiveSettings, LiveSuspension
from suspnet.recordings.frames import MOST_CHARACTERS
from suspnet.recordings.manifest import TripManifest
from suspnet.recordings.manifest_keys import TripError
from suspnet.trips.fleet import FleetSettings
from suspnet.trips.grouping import find_groups
from suspnet.trips.models import models_of


def read_suspensions(
    folder: Path, models: Sequence[TrainedModel], settings: FleetSettings, live: LiveSettings
) -> list[LiveSuspension]:
    """Return each suspension that a folder has manifests of.

    Parameters
    ----------
    folder : Path
        As `evaluate_fleet` takes it: of one suspension's trips, of several, or with subfolders.
        Data files need not be there.
    models : sequence of TrainedModel
    settings : FleetSettings
    live : LiveSettings

    Raises
    ------
    FileNotFoundError
        If there is no manifest.
    TripError
        If a manifest is faulty, is of another vehicle, lacks the unit of a sensor's range, or has a
        name that frames cannot have.
    ModelFileError
        If a suspension has no model, or the limits do not go together.
    """
    found = []
    for group in find_groups(folder):
        if group.error:
            raise TripError(f"{group.folder}: {group.error}")
        manifest = max((file.live_trip for file in group.manifests), key=_km)
        name = str(manifest.place)
        if not name.isprintable() or len(name) > MOST_CHARACTERS:
            raise TripError(
                f"{manifest.path}: frames cannot name the suspension {name[:80]!r}; a name is "
                f"plain text of at most {MOST_CHARACTERS} characters"
            )
        fitting = models_of(models, group.place)
        settings.limits_of(fitting)
        if (vehicle := fitting[0].vehicle.name) != manifest.vehicle:
            raise TripError(
                f"{manifest.path}: the trip is of vehicle {manifest.vehicle!r}, the model was "
                f"trained for {vehicle!r}"
            )
        found.append(LiveSuspension(manifest, fitting, settings.trips, live))
    return found


def _km(manifest: TripManifest) -> float:
    """Return the mileage of a manifest; one without is before all others."""
    return -1.0 if math.isnan(manifest.mileage_km) else manifest.mileage_km
