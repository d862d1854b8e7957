"""Files written atomically, and arrays checked before they are used."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save


class DamagedFileError(ValueError):
    """A file is truncated, altered or of another format."""


def write_atomically(path: Path, content: bytes | str) -> Path:
    """Write a file through a temporary one in the same folder, fsync and rename.

    Raises
    ------
    OSError
        If the folder cannot be written; nothing is left behind.
    """
    data = content.encode() if isinstance(content, str) else content
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    return path


def write_json(path: Path, content: Any) -> Path:
    """Write `content` as indented JSON, atomically; NaN becomes null."""
    return write_atomically(path, json.dumps(_finite(content), indent=2, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Return what a JSON file holds.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    DamagedFileError
        If it is not valid JSON.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise DamagedFileError(f"{path} is damaged or not JSON ({error})") from error


def dump_arrays(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return arrays in the safetensors format."""
    return save({name: np.array(array, order="C") for name, array in arrays.items()})


def read_arrays(path: Path, sha256: str | None = None) -> dict[str, NDArray[Any]]:
    """Return the arrays of a safetensors file.

    Parameters
    ----------
    path : Path
    sha256 : str, optional
        The hash the file must have.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    DamagedFileError
        If the file is truncated, altered or of another format.
    """
    content = path.read_bytes()
    if sha256 is not None and hashlib.sha256(content).hexdigest() != sha256:
        raise DamagedFileError(
            f"{path} is damaged: its {len(content)} bytes do not match the hash in its JSON file"
        )
    try:
        return load(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise DamagedFileError(f"{path} is damaged or not a safetensors file ({error})") from error


def content_hash(description: Any) -> str:
    """Return the SHA-256 of a JSON-able description, for naming what was made from it."""
    return hashlib.sha256(json.dumps(description, sort_keys=True).encode()).hexdigest()


def _umask() -> int:
    """Return the process's umask, which only setting it reveals."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _finite(content: Any) -> Any:
    """Return JSON-able values with null for NaN and infinity."""
    if isinstance(content, Mapping):
        return {str(key): _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    if isinstance(content, np.generic):
        content = content.item()
    if isinstance(content, float) and not np.isfinite(content):
        return None
    return content
