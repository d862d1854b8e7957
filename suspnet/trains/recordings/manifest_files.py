"""Manifests as YAML files: searched in folders, read once, checked completely, and written."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from suspnet.ground.core_yaml import MOST_BYTES, dump_yaml, parse_yaml
from suspnet.ground.findings import Finding, at
from suspnet.ground.parameters import ENDS, SIDES
from suspnet.ground.records import MOST_NAME, Place
from suspnet.ground.storage import one_line, read_plain, why, write_atomically
from suspnet.ground.wording import command
from suspnet.trains.recordings.errors import TripError, all_of, opening
from suspnet.trains.recordings.manifest import (
    FORMAT,
    MANIFEST,
    RECORD,
    RECORD_FORMAT,
    RecordManifest,
    TripManifest,
)
from suspnet.trains.recordings.manifest_sources import Value, keys_of

NAMES = ("vehicle", "suspension", "train", "car")  # keys of names, which may be numbers


@dataclass(frozen=True)
class ManifestFile:
    """One manifest, whose file is read only once."""

    path: Path

    @cached_property
    def data(self) -> bytes:
        """Bytes of the file; TripError if it cannot be read."""
        with opening(self.path):
            return read_plain(self.path, MOST_BYTES)

    @cached_property
    def content(self) -> Any:
        """Unchecked content of the YAML file; TripError if it is not YAML."""
        data = self.data
        try:
            return parse_yaml(data.decode("utf-8-sig"), NAMES)
        except ValueError as error:
            raise TripError.at(self.path, "invalid-yaml", error=error) from error

    def absolute(self) -> ManifestFile:
        """Return the same file by its absolute path, without reading it again."""
        file = ManifestFile(self.path.absolute())
        vars(file).update({k: v for k, v in vars(self).items() if k in ("data", "content")})
        return file

    @cached_property
    def trip(self) -> TripManifest:
        """The checked trip.

        Raises TripError with all `problems`: unreadable file, unknown or missing keys, wrong or
        out-of-range values, missing data files, two sensors with the same column of one file.
        """
        content = self.content
        manifest: TripManifest
        manifest, _ = all_of([lambda: _parsed(self.path, content), self._check_files])
        _check_columns(manifest)
        return manifest

    @property
    def live_trip(self) -> TripManifest:
        """The checked trip of sensors that send frames; `file` keys and files may be missing."""
        content = self.content
        if isinstance(content, dict):
            content = content | {"speed": _with_file(content.get("speed"))}
            channels = content.get("channels")
            if isinstance(channels, dict):
                content["channels"] = {name: _with_file(its) for name, its in channels.items()}
        return _parsed(self.path, content)

    @property
    def place(self) -> Place | None:
        """The suspension of the trip; None if it is not stated.

        Nothing else is checked, so a faulty trip is still grouped with others of its suspension.
        """
        try:
            content = self.content
        except TripError:
            return None
        if not isinstance(content, dict) or not isinstance(content.get("suspension"), str):
            return None
        ends = {"bogie": ENDS, "side": SIDES}
        where = {key: str(content[key]) for key in ends if content.get(key) in list(ends[key])}
        texts = {key: content.get(key) for key in ("suspension", "train", "car")}
        named = {k: one_line(text.strip()) for k, text in texts.items() if isinstance(text, str)}
        is_short = all(len(text) <= MOST_NAME for text in named.values())
        return Place(**where, **named) if is_short else None

    @property
    def axle(self) -> str:
        """Axle of the bogie that the sensors are at; empty if it is not stated. Not checked."""
        with contextlib.suppress(TripError):
            if isinstance(self.content, dict) and self.content.get("axle") in list(ENDS):
                return str(self.content["axle"])
        return ""

    @property
    def sources(self) -> dict[str, dict[str, Any]]:
        """All mappings of the unchecked content that name a file, by key."""
        if not isinstance(self.content, dict):
            return {}
        sources, channels = {"speed": self.content.get("speed")}, self.content.get("channels")
        for name, source in channels.items() if isinstance(channels, dict) else ():
            several = source if isinstance(source, list) else []
            sources[f"channels.{name}"] = source
            sources |= {f"channels.{name}[{i}]": sensor for i, sensor in enumerate(several)}
        return {
            key: source
            for key, source in sources.items()
            if isinstance(source, dict) and isinstance(source.get("file"), str)
        }

    def _check_files(self) -> None:
        folder = self.path.parent
        problems = [
            at(self.path, "no-data-file", key=key, source=repr(source["file"]), folder=folder)
            for key, source in self.sources.items()
            if not os.path.isfile(folder / source["file"])  # False also for too long a name
        ]
        if problems:
            raise TripError(*problems)


def read_manifest(path: str | Path) -> TripManifest:
    """Return a checked manifest; TripError, as of ``ManifestFile.trip``, if anything is wrong."""
    return ManifestFile(Path(path)).trip


def _parsed(path: Path, content: Any) -> TripManifest:
    of_rig = is_of_rig(content)
    values = Value(path, "", content).read(RECORD if of_rig else MANIFEST)
    del values["format"]
    return (RecordManifest if of_rig else TripManifest)(path=path, name=path.stem, **values)


def is_of_rig(content: Any) -> bool:
    """Return whether the content of a manifest is that of a rig's record; nothing is checked."""
    return isinstance(content, dict) and content.get("format") == RECORD_FORMAT


def _with_file(source: Any) -> Any:
    if isinstance(source, list):
        return [_with_file(sensor) for sensor in source]
    return {"file": "frames"} | source if isinstance(source, dict) else source


def _check_columns(manifest: TripManifest) -> None:
    places: dict[tuple[Path, str | None], str] = {}
    for name, sensor in manifest.sensors().items():
        other = places.setdefault((manifest.file_of(sensor).resolve(), sensor.column), name)
        if other != name:
            raise TripError.at(manifest.path, "same-column-twice", other=other, name=name)


def write_manifest(manifest: TripManifest) -> Path:
    """Write a manifest atomically to its own path and return that.

    Raises TripError if it could not be read back: a value is wrong, or the name is not the file's.
    """
    values = {name: _written(getattr(manifest, name)) for name in keys_of(TripManifest)}
    content = {"format": FORMAT} | {k: v for k, v in values.items() if v not in (None, {})}
    if _parsed(manifest.path, content).name != manifest.name:
        raise TripError(f"{manifest.path}: `name` must be that of the file, got {manifest.name!r}")
    return write_atomically(manifest.path, dump_yaml(content))


def _written(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {key: _written(content) for key, content in value.items() if content is not None}
    return [_written(content) for content in value] if isinstance(value, tuple) else value


def find_manifests(folder: Path) -> list[Path]:
    """Return the ``*.yaml`` files directly in a folder, sorted; FileNotFoundError if none."""
    if not folder.is_dir():
        raise FileNotFoundError(Finding("no-trip-folder", folder=folder))
    manifests = sorted(path for path in folder.glob("*.yaml") if path.is_file())
    if not manifests:
        raise FileNotFoundError(
            Finding("no-manifests", folder=folder, value=command("init", folder))
        )
    return manifests


def find_trips(paths: Iterable[Path]) -> tuple[list[Path], list[str]]:
    """Return the manifests of files and folders, and messages about paths that have none.

    A folder gives its own ``*.yaml`` files or, if it has none, those of its subfolders.
    """
    manifests: list[Path] = []
    problems = []
    for path in paths:
        try:
            manifests += _manifests(path) or find_manifests(path)
        except OSError as error:
            problems.append(why(error))
    return list(dict.fromkeys(manifests)), problems


def _manifests(path: Path) -> list[Path]:
    if path.is_dir():
        below = (p for p in path.glob("*/*.yaml") if p.is_file() and p.parent.name[0] != ".")
        return find_manifests(path) if any(path.glob("*.yaml")) else sorted(below)
    if not os.path.lexists(path):
        raise FileNotFoundError(Finding("no-file-or-folder", path=path))
    if path.suffix not in (".yaml", ".yml"):
        raise OSError(Finding("no-manifest", path=path, value=command("init", path)))
    return [path]
