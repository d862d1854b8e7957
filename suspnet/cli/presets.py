"""What the command line of ``suspnet train healthy=DIR`` need not say: the manifests there do."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

OF_HEALTHY = "experiment=trips"
"""Experiment of models that are commissioned on healthy trips."""


def of_healthy(
    typed: Mapping[str, str | None], options: Sequence[str], name_of: Callable[[str], str | None]
) -> list[str]:
    """Return the overrides that a folder of healthy trips implies where the user gives none.

    `typed` are the values of the keys and groups that the command line sets, as text. `options`
    are those of the group `vehicle`, of which `name_of` returns the name of the vehicle.
    """
    folder = typed.get("healthy")
    if not folder or folder == "null" or "experiment" in typed:
        return []
    overrides = [OF_HEALTHY]
    if "vehicle" not in typed and (vehicle := _vehicle_in(Path(folder))):
        named = [vehicle] if vehicle in options else []
        named += [option for option in options if name_of(option) == vehicle]
        overrides += [f"vehicle={option}" for option in named[:1]]
    return overrides


def _vehicle_in(folder: Path) -> str | None:
    """Return the vehicle of the first manifest in a folder or its subfolders; None without one.

    What is wrong with the folder, or missing to read trips, is said when they are read.
    """
    with suppress(ImportError, OSError, ValueError):
        from suspnet.trains.recordings.manifest_files import ManifestFile, find_manifests

        for place in (folder, *sorted(path for path in folder.iterdir() if path.is_dir())):
            with suppress(OSError, ValueError):
                content = ManifestFile(find_manifests(place)[0]).content
                return content.get("vehicle") if isinstance(content, dict) else None
    return None
