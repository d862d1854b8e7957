"""Columns written in every format that recordings are read from."""

import csv
import warnings
from collections.abc import Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat, wavfile

from suspnet.trains.recordings.formats import CSV_SUFFIXES
from suspnet.trains.recordings.manifest import TripManifest
from suspnet.trains.recordings.manifest_sources import FileSource
from suspnet.trains.recordings.sources import open_source

EXTRAS = {"asammdf": "mdf", "h5py": "hdf5", "nptdms": "tdms", "pyuff": "uff"}


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


@contextmanager
def hdf5_file(path: Path):
    """Open an HDF5 file to write it; a MAT file of version 7.3 has a header in front."""
    is_mat = path.suffix == ".mat"
    with needed("h5py").File(path, "w", userblock_size=512 if is_mat else 0) as file:
        yield file
    if is_mat:
        with path.open("r+b") as stream:
            stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


def write_hdf5(path: Path, columns: Mapping, **said) -> None:
    with hdf5_file(path) as file:
        for name, values in columns.items():
            file[name] = np.asarray(values)[None, :]  # as MATLAB 7.3 does
            for key, value in said.items():
                file[name].attrs[key] = value


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


def write_uff(path: Path, columns: Mapping, **said) -> None:
    pyuff = needed("pyuff")
    if not len(next(iter(columns.values()))):
        path.write_text("")
        return
    known = {"rate_hz", "unit", "date", "units_code"}
    rate_hz = said.get("rate_hz", 1.0)
    about = {"abscissa_min": 0.0, "abscissa_inc": 1 / rate_hz, "abscissa_spacing": 1}
    about |= {key: said[key] for key in said.keys() - known}
    records = []
    if "units_code" in said:
        lengths = dict.fromkeys(("length", "force", "temp", "temp_offset"), 1.0)
        texts = {"units_description": "", "temp_mode": 1}
        records.append({"type": 164, "units_code": said["units_code"]} | texts | lengths)
    for name, values in columns.items():
        at = about["abscissa_min"] + np.arange(len(values)) / rate_hz
        values = np.asarray(values).astype(np.float64)
        about.setdefault("ordinate_axis_units_lab", said.get("unit", ""))
        record = pyuff.prepare_58(
            binary=1, func_type=1, id1=name, rsp_node=1, rsp_dir=3, ref_node=1, ref_dir=3,
            data=values, x=at, num_pts=len(values), ordinate_spec_data_type=12,
            id3=said.get("date", ""), return_full_dict=True, **about,
        )  # fmt: skip
        empty = {key: 0 for key, value in record.items() if value is None and key[-4:] != "_lab"}
        texts = {
            key: "NONE" for key in record if key.endswith(("_lab", "_name")) and not record[key]
        }
        records.append(record | empty | texts | {"ord_data_type": 4})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)  # pyuff leaves its files open
        for record in records:
            pyuff.UFF(str(path)).write_sets(record, "add")


def write_wav(path: Path, columns: Mapping, **said) -> None:
    values = np.stack([np.asarray(v).astype(np.float64) for v in columns.values()], axis=1)
    wavfile.write(path, round(said.get("rate_hz", 1.0)), values)
    if "date" in said:  # a broadcast WAV file: description, originator, reference, date and time
        chunk = bytes(320) + said["date"].encode() + bytes(264)
        content = path.read_bytes() + b"bext" + len(chunk).to_bytes(4, "little") + chunk
        path.write_bytes(content[:4] + (len(content) - 8).to_bytes(4, "little") + content[8:])


WRITERS = {
    ".parquet": write_parquet,
    **dict.fromkeys(CSV_SUFFIXES, write_csv),
    ".mat": write_mat,
    ".h5": write_hdf5,
    ".hdf5": write_hdf5,
    ".tdms": write_tdms,
    ".mf4": write_mdf,
    ".mdf": write_mdf,
    ".uff": write_uff,
    ".unv": write_uff,
    ".wav": write_wav,
}
