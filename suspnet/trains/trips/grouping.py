"""Grouping of the trips of a folder by suspension."""

import logging
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from suspnet.ground.findings import Finding
from suspnet.ground.own_files import MARKER
from suspnet.ground.records import Key, Place
from suspnet.ground.storage import distinct, why
from suspnet.trains.recordings.manifest_files import ManifestFile, find_manifests

log = logging.getLogger(__name__)
TAKEN = (
    *("overview.html", "overview.csv", "overview.parquet", "config.yaml", "exit_code", "figures"),
    *("fleet.json", "error.txt", MARKER),
)
"""File names in the output that no suspension's folder may have."""


@dataclass(frozen=True)
class Group:
    """The trips of one suspension.

    `folder` holds the manifests; `name` is unique among groups and a valid folder name; `error`
    states why there are no manifests, empty if there are some.
    """

    folder: Path
    place: Place
    manifests: tuple[ManifestFile, ...] = ()
    name: str = ""
    error: str = ""

    @property
    def axle(self) -> str:
        """The only axle that the manifests name; empty if there is none."""
        named = {manifest.axle for manifest in self.manifests} - {""}
        return named.pop() if len(named) == 1 else ""


def find_groups(folder: Path) -> list[Group]:
    """Return a folder's trips by suspension, or those of its subfolders if it holds no manifest.

    A manifest that does not name its suspension belongs to the only one of its folder, or to none.
    FileNotFoundError is raised if there is no such folder, or no manifest in it or its subfolders.
    """
    if not folder.is_dir() or _holds_manifests(folder):
        groups = _split(folder, find_manifests(folder))
        if unread := sorted(p.name for p in folder.iterdir() if p.is_dir() and _holds_manifests(p)):
            words = "%s holds manifests of its own, so its subfolders are not read: %s"
            log.warning(words, folder, ", ".join(unread))
        return _named(groups, folder)
    groups = []
    for part in sorted(path for path in folder.iterdir() if path.is_dir()):
        if part.name.startswith("."):
            continue
        try:
            manifests = find_manifests(part)
        except OSError as error:
            groups.append(Group(part, Place(part.name), error=why(error)))
            continue
        split = _split(part, manifests)
        if all(group.place == Place() for group in split):
            words = Finding("no-suspension-named", n_manifests=len(manifests))
            split = [Group(part, Place(part.name), error=words)]
        groups += split
    if not any(group.manifests for group in groups):
        find_manifests(folder)  # raises the reason
    return _named(groups, folder)


def group_names(places: Sequence[tuple[Path, Place]], folder: Path) -> list[str]:
    """Return a unique name for each suspension of a folder, given by its own folder and its place.

    It is that of the subfolder, with the place where that holds several.
    """
    several = Counter(part for part, _ in places)
    names = [
        str(place) if part == folder else f"{part.name}_{place}" if several[part] > 1 else part.name
        for part, place in places
    ]
    plain = [re.sub(r"[^\w.-]+", "_", name).strip("._")[:100] or "unknown" for name in names]
    return distinct(plain, TAKEN)


def lone_trains(places: Iterable[Key]) -> dict[str, list[str]]:
    """Return the suspensions of each vehicle that are trains of their own as none is named.

    Only vehicles with several; bogies and sides of one suspension are in one train.
    """
    alone: dict[str, set[str]] = {}
    for vehicle, place in places:
        if not place.train:
            alone.setdefault(vehicle, set()).add(str(replace(place, bogie="", side="")))
    return {vehicle: sorted(several) for vehicle, several in alone.items() if len(several) > 1}


def _holds_manifests(folder: Path) -> bool:
    return any(path.is_file() for path in folder.glob("*.yaml"))


def _split(folder: Path, manifests: Iterable[Path]) -> list[Group]:
    files = [ManifestFile(path) for path in manifests]
    named = {file.place for file in files if file.place is not None}
    unnamed = named.pop() if len(named) == 1 else Place()
    by_place: dict[Place, list[ManifestFile]] = {}
    for file in files:
        by_place.setdefault(file.place or unnamed, []).append(file)
    return [Group(folder, place, tuple(by_place[place])) for place in sorted(by_place)]


def _named(groups: list[Group], folder: Path) -> list[Group]:
    names = group_names([(group.folder, group.place) for group in groups], folder)
    return [replace(group, name=name) for group, name in zip(groups, names, strict=True)]
