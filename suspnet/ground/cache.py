"""Cache of arrays in files; a result is recomputed if its file is missing or doubtful.

Libraries that cache results (joblib.Memory, diskcache) read pickles, which can run any code; these
files contain only numbers and JSON.
"""

import functools
import hashlib
import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save

from suspnet.ground.storage import (
    MOST_BYTES,
    content_hash,
    load_arrays,
    read_plain,
    write_atomically,
)

log = logging.getLogger(__name__)
ABOUT = "suspnet"
"""Header entry with the description from which the arrays were made, notes and a checksum."""
Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class Cache:
    """Arrays and notes in a folder, by the description from which they were made.

    A file contains the arrays, the notes, the description and a checksum of all of these. A file
    that does not match is ignored with a warning. A folder that cannot be read or written is
    ignored with one warning. With `folder` None nothing is stored. `kind` starts the file names.
    """

    folder: Path | str | None
    kind: str

    def read(self, made_from: Any) -> tuple[dict[str, NDArray[Any]], Any] | None:
        """Return arrays and notes made from a JSON-able description; None if they are missing."""
        if self.folder is None:
            return None
        path = self.path(made_from)
        try:
            content = read_plain(path, MOST_BYTES)
            arrays = load_arrays(content, str(path))
            about = _about(content)
        except FileNotFoundError:
            return None
        except (ValueError, LookupError, TypeError, RecursionError, MemoryError) as error:
            log.warning("ignoring a damaged cache file: %s", " ".join(str(error).split()))
            return None
        except OSError as error:
            _warn_once(str(self.folder), "read", str(error.strerror or error))
            return None
        if about.get("sha256") != _checksum(arrays, about.get("made_from"), about.get("notes")):
            log.warning("ignoring a damaged cache file: %s does not match its checksum", path)
        elif about.get("made_from") != json.loads(json.dumps(made_from)):
            log.warning("ignoring a damaged cache file: %s was made from something else", path)
        else:
            return arrays, about.get("notes")
        return None

    def write(self, made_from: Any, arrays: Arrays, notes: Any = None) -> None:
        """Store arrays and JSON-able notes that were made from a JSON-able description."""
        if self.folder is None:
            return
        arrays = {name: np.array(array, order="C") for name, array in arrays.items()}
        about = {"made_from": made_from, "notes": notes}
        about["sha256"] = _checksum(arrays, made_from, notes)
        content = save(arrays, {ABOUT: json.dumps(about)})
        try:
            write_atomically(self.path(made_from), content)
        except OSError as error:
            _warn_once(str(self.folder), "written", str(error.strerror or error))

    def path(self, made_from: Any) -> Path:
        """Return the path of the file for a description."""
        assert self.folder is not None
        return Path(self.folder) / f"{self.kind}-{content_hash(made_from)[:32]}.safetensors"


@functools.cache
def code_hash() -> str:
    """Return a hash of this package's code, which invalidates files of older code."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted([*package.rglob("*.py"), *package.rglob("*.csv")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _checksum(arrays: Arrays, made_from: Any, notes: Any) -> str:
    """Return the SHA-256 of arrays with names, types and shapes, description and notes."""
    digest = hashlib.sha256(json.dumps([made_from, notes], sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(json.dumps([name, array.dtype.str, array.shape]).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _about(content: bytes) -> dict[str, Any]:
    """Return the entry ``ABOUT`` of a file's header; {} if there is none."""
    header = json.loads(content[8 : 8 + int.from_bytes(content[:8], "little")])
    about = json.loads(header.get("__metadata__", {}).get(ABOUT, "{}"))
    return about if isinstance(about, dict) else {}


@functools.cache
def _warn_once(folder: str, verb: str, reason: str) -> None:
    log.warning("the cache folder %s cannot be %s, which costs time only: %s", folder, verb, reason)
