"""Columns written in every format that recordings are read from."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from suspnet.trains.recordings.formats import CSV_SUFFIXES
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_sources import FileSource
from suspnet.trains.recordings.sources import open_source

EXTRAS = {"asammdf": "mdf", "nptdms": "tdms"}


def needed(module: str):
    """Return a module of an extra; the test is skipped where it is not installed."""
    reason = f'runs after pip install -e ".[{EXTRAS[module]}]"'
    return pytest.importorskip(module, reason=reason)


def bare_manifest(folder: Path) -> TripManifest:
    """Return a manifest that says nothing."""
    return TripManifest(
        path=folder / "trip.yaml",
        name="trip",
        vehicle="",
        suspension="",
        mileage_km=0.0,
        speed=1.0,
        channels={},
    )


def opened(path: Path, source: FileSource, where: str = "here"):
    """Open a source next to a manifest that says nothing else."""
    return open_source(bare_manifest(path.parent), source, where)


def contents(folder: Path) -> dict[str, bytes]:
    """Return the bytes of all files of a folder and below it, by their relative names."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def write_parquet(path: Path, columns: Mapping, **_) -> None:
    pq.write_table(pa.table(dict(columns)), path, row_group_size=7)


def write_csv(path: Path, columns: Mapping, **said) -> None:
    with path.open("w", newline="") as stream:
        stream.writelines(said.get("above", ()))
        rows = csv.writer(stream)
        rows.writerow(columns)
        rows.writerows(zip(*(np.asarray(c).tolist() for c in columns.values()), strict=True))


def write_mat(path: Path, columns: Mapping, **_) -> None:
    savemat(path, dict(columns))


def write_tdms(path: Path, columns: Mapping, **said) -> None:
    nptdms = needed("nptdms")
    properties = {"wf_increment": 1 / said["rate_hz"]} if "rate_hz" in said else {}
    properties |= {"unit_string": said["unit"]} if "unit" in said else {}
    properties |= {"wf_start_time": said["start"]} if "start" in said else {}
    with nptdms.TdmsWriter(path) as writer:
        for part in (slice(0, 5), slice(5, None)):  # two segments
            writer.write_segment(
                [
                    nptdms.ChannelObject("g", n, np.asarray(v)[part], properties=properties)
                    for n, v in columns.items()
                ]
            )


def write_mdf(path: Path, columns: Mapping, **said) -> None:
    asammdf = needed("asammdf")
    with asammdf.MDF(version="4.10") as file:
        at = np.arange(len(next(iter(columns.values())))) / said.get("rate_hz", 1.0)
        file.append(
            [
                asammdf.Signal(np.asarray(values), at, name=name, unit=said.get("unit", ""))
                for name, values in columns.items()
            ]
        )
        if "start" in said:
            file.start_time = said["start"]
        written = file.save(path.with_suffix(".new.mf4"), overwrite=True)
    written.rename(path)


WRITERS = {
    ".parquet": write_parquet,
    **dict.fromkeys(CSV_SUFFIXES, write_csv),
    ".mat": write_mat,
    ".tdms": write_tdms,
    ".mf4": write_mdf,
    ".mdf": write_mdf,
}
