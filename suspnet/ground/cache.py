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

from numpy.typing import NDArray

from suspnet.ground import storage

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Cache:
    """Arrays and notes in a folder, by the description from which they were made.

    A file contains the notes and the arrays, after a checksum of these and the description. A file
    that does not match is ignored with a warning. A folder that cannot be read or written is
    ignored with one warning.
    """

    folder: Path

    def read(self, made_from: Any) -> tuple[dict[str, NDArray[Any]], Any] | None:
        """Return arrays and notes made from a JSON-able description; None if they are missing."""
        path = self.path(made_from)
        try:
            checksum, _, content = storage.read_plain(path, storage.MOST_BYTES).partition(b"\n")
            if checksum != _checksum(made_from, content):
                raise ValueError(f"{path} does not match its checksum")
            notes, _, arrays = content.partition(b"\n")
            return storage.load_arrays(arrays, str(path)), json.loads(notes)
        except FileNotFoundError:
            return None
        except (ValueError, RecursionError, MemoryError) as error:
            log.warning("ignoring a damaged cache file: %s", " ".join(str(error).split()))
        except OSError as error:
            _warn_once(str(self.folder), "read", str(error.strerror or error))
        return None

    def write(self, made_from: Any, arrays: Mapping[str, NDArray[Any]], notes: Any) -> None:
        """Store arrays and JSON-able notes that were made from a JSON-able description."""
        content = json.dumps(notes).encode() + b"\n" + storage.dump_arrays(arrays)
        try:
            storage.write_atomically(
                self.path(made_from), _checksum(made_from, content) + b"\n" + content
            )
        except OSError as error:
            _warn_once(str(self.folder), "written", str(error.strerror or error))

    def path(self, made_from: Any) -> Path:
        """Return the path of the file for a description."""
        return self.folder / f"{storage.content_hash(made_from)[:32]}.cache"


@functools.cache
def code_hash() -> str:
    """Return a hash of this package's code, which invalidates files of older code."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for file in sorted([*package.rglob("*.py"), *package.rglob("*.csv")]):
        digest.update(file.read_bytes())
    return digest.hexdigest()


def _checksum(made_from: Any, content: bytes) -> bytes:
    """Return the SHA-256 of a description and what was made from it, in hexadecimal digits."""
    digest = hashlib.sha256(storage.content_hash(made_from).encode() + content)
    return digest.hexdigest().encode()


@functools.cache
def _warn_once(folder: str, verb: str, reason: str) -> None:
    log.warning("the cache folder %s cannot be %s, which costs time only: %s", folder, verb, reason)
