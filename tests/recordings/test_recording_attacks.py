"""Recordings that would act, and such as declare more than they hold; all of them with -m slow.

Each ends in one line within seconds and in bounded memory: nothing is run, written or changed, and
nothing of another file comes in.
"""

import hashlib
import json
import os
import stat
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from acting_files import ACTING, HARMLESS, SECRET, prepare
from declaring_files import DECLARING, WITHIN_BOUNDS
from read_all import read_all

SECONDS, WALL_SECONDS = 10.0, 60.0
"""Longest processor time for one file, and longest time on a machine that is busy with ten others.

The longest are 500 MB of packed zeros, unpacked twice; the first file starts the reader."""
MOST_OWN_BYTES, MOST_READER_BYTES = 0.6e9, 1.7e9
"""Largest memory of the process that asks and of a reader, their libraries (0.2 GB) included."""
FEW_ACTING = (
    *("mdf system", "mdf 3.30", "tdms index", "hdf5 external", "hdf5 link"),
    *("hdf5 virtual", "hdf5 plugin", "mat 7.3 external"),
)
FEW_DECLARING = (
    *("mat", "pipe as .csv", "mdf", "hdf5", "hdf5 of one piece", "wav of 16 bits", "uff"),
)


@pytest.fixture
def bait(tmp_path):
    """Return a folder with what must not be touched, and a hash of what it holds."""
    (tmp_path / "bait").mkdir()
    (tmp_path / "bait" / "precious").write_text("precious")
    return tmp_path / "bait"


def state(folder: Path) -> str:
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        found = path.lstat()
        digest.update(repr((str(path), found.st_mode, found.st_size, found.st_mtime_ns)).encode())
        if stat.S_ISREG(found.st_mode) and found.st_size < 10**6:  # no link to a huge file
            digest.update(path.read_bytes())
    return digest.hexdigest()


def written(folder: Path, payloads, names) -> dict[str, Path]:
    """Write files, each into a folder of its own."""
    paths = {}
    for number, name in enumerate(names):
        (folder / str(number)).mkdir(parents=True)
        prepare(folder / str(number))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the packages warn of what they are made to write
            paths[name] = payloads[name](folder / str(number))
    return paths


def check(name: str, path: Path, found: dict, harmless) -> None:
    """Check what came of reading a file."""
    assert not (path.parent / "canary").exists(), name
    assert not found["leaked"], name
    assert all("\n" not in error and path.name in error for error in found["errors"]), name
    assert found["errors"] or name in harmless, name
    assert found["cpu"] < SECONDS, (name, found)
    assert found["seconds"] < WALL_SECONDS, (name, found)


@pytest.mark.parametrize(
    ("payloads", "names", "harmless"),
    [(ACTING, FEW_ACTING, HARMLESS), (DECLARING, FEW_DECLARING, WITHIN_BOUNDS)],
    ids=["acting", "declaring"],
)
def test_few_files_do_nothing(tmp_path, bait, payloads, names, harmless):
    paths = written(tmp_path / "files", payloads, names)
    before = state(tmp_path)
    for name, path in paths.items():
        check(name, path, read_all(path, SECRET), harmless)
    assert state(tmp_path) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("payloads", "harmless"),
    [(ACTING, HARMLESS), (DECLARING, WITHIN_BOUNDS)],
    ids=["acting", "declaring"],
)
def test_all_files_do_nothing_in_bounded_memory(tmp_path, bait, payloads, harmless):
    paths = written(tmp_path / "files", payloads, payloads)
    before = state(tmp_path)
    path = os.pathsep.join(sys.path)
    script = str(Path(__file__).parents[1] / "read_all.py")
    done = subprocess.run(
        [sys.executable, script, str(SECRET), *map(str, paths.values())],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path, "HDF5_PLUGIN_PATH": str(bait)},
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    answer = json.loads(done.stdout)
    for name, place in paths.items():
        check(name, place, answer["found"][str(place)], harmless)
    assert state(tmp_path) == before
    assert answer["own"] < MOST_OWN_BYTES
    assert answer["readers"] < MOST_READER_BYTES


def test_secret_is_read_where_it_is_asked_for(tmp_path):
    """The test would see it if it came in."""
    prepare(tmp_path)
    assert read_all(tmp_path / "secret.mat", SECRET)["leaked"]
    assert np.fromfile(tmp_path / "secret")[0] == SECRET
