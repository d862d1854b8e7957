"""Small data files that declare far more than they hold, or that are no files at all.

Each function of ``DECLARING`` writes one into a folder and returns its path.
"""

import os
import socket
import struct
import zlib
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from recording_files import hdf5_file, needed, write_mdf, write_tdms, write_uff

A = np.arange(50.0)


# HDF5


def hdf5(folder: Path, *, shape, suffix=".h5", **how) -> Path:
    """Write a data set of which nothing is stored but its shape."""
    with hdf5_file(folder / f"data{suffix}") as file:
        file.create_dataset("a", shape, "f8", **how)
    return folder / f"data{suffix}"


def hdf5_note(folder: Path, *, size: int) -> Path:
    """Write an attribute's neighbour, a text of gigabytes, beside a column."""
    with hdf5_file(folder / "data.h5") as file:
        file["g/a"] = A
        file.create_dataset("g/unit", (1,), f"S{size}", chunks=None)
        file.create_dataset("g/fs", (10**8,), "f8", chunks=(10**6,))
    return folder / "data.h5"


# MAT


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content.ljust(-(-len(content) // 8) * 8, b"\0")


def mat_head(n: int, n_bytes: int, *, rows: int = 1, kind: int = 9) -> bytes:
    """Return the first bytes of a variable of n doubles whose data have some bytes."""
    inner = element(6, struct.pack("<II", 6, 0)) + element(5, struct.pack("<ii", rows, n))
    inner += element(1, b"a") + struct.pack("<II", kind, n_bytes)
    return struct.pack("<II", 14, (len(inner) + n_bytes) % 2**32) + inner


MAT = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + struct.pack("<H", 0x0100) + b"IM"


def mat(folder: Path, *, n: int, packed_bytes: int = 0, kind: int = 9, rows: int = 1) -> Path:
    """Write a MAT file that declares n doubles and holds none, or packed zeros."""
    width = {9: 8, 2: 1}[kind]
    content = mat_head(n, min(rows * n * width, 2**32 - 1), kind=kind, rows=rows)
    if packed_bytes:
        pack = zlib.compressobj(9)
        packed = pack.compress(content) + pack.flush(zlib.Z_FULL_FLUSH)
        block = pack.compress(bytes(2**22)) + pack.flush(zlib.Z_FULL_FLUSH)
        packed += block * (packed_bytes // 2**22)
        content = struct.pack("<II", 15, len(packed)) + packed
    (folder / "data.mat").write_bytes(MAT + content)
    return folder / "data.mat"


def mat_4(folder: Path, *, n: int, columns: int = 1) -> Path:
    """Write a MAT file of version 4 that declares n doubles; its hole is as long, if it may be."""
    path = folder / "data.mat"
    path.write_bytes(struct.pack("<iiiii", 0, n, columns, 0, 2) + b"a\0" + bytes(80))
    os.truncate(path, 22 + 8 * n * columns)
    return path


# Parquet


def parquet(folder: Path, *, n: int) -> Path:
    """Write a Parquet file with n rows of nothing."""
    table = pa.table({"a": pa.nulls(10**7, pa.float32())})
    with pq.ParquetWriter(folder / "data.parquet", table.schema, compression="zstd") as writer:
        for _ in range(n // 10**7):
            writer.write_table(table)
    return folder / "data.parquet"


def parquet_columns(folder: Path, *, n_columns: int) -> Path:
    """Write a Parquet file with very many columns."""
    columns = {f"a{i}": pa.nulls(3, pa.float32()) for i in range(n_columns)}
    pq.write_table(pa.table(columns), folder / "data.parquet")
    return folder / "data.parquet"


# WAV


def wav(folder: Path, *, n_bytes: int, bits: int = 16, form: int = 1) -> Path:
    """Write a WAV file that is one hole."""
    path, frame = folder / "data.wav", bits // 8
    head = b"RIFF" + struct.pack("<I", n_bytes + 36) + b"WAVE"
    head += b"fmt " + struct.pack("<IHHIIHH", 16, form, 1, 1000, 1000 * frame, frame, bits)
    path.write_bytes(head + b"data" + struct.pack("<I", n_bytes))
    os.truncate(path, path.stat().st_size + n_bytes)
    return path


# TDMS, MDF, UFF, CSV


def patched(path: Path, old: bytes, new: bytes) -> Path:
    """Return a file in which some bytes are replaced wherever they are."""
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new))
    return path


def tdms(folder: Path, *, n: int, hole: int = 0) -> Path:
    """Write a TDMS file whose index declares n values, and perhaps a hole that holds them."""
    write_tdms(folder / "data.tdms", {"a": np.arange(5.0)})
    path = patched(folder / "data.tdms", struct.pack("<IQ", 1, 5), struct.pack("<IQ", 1, n))
    if hole:
        content = path.read_bytes()
        place = content.index(b"TDSm", 4) if content.count(b"TDSm") > 1 else len(content)
        first = bytearray(content[:place])
        raw = struct.unpack_from("<Q", first, 20)[0]
        struct.pack_into("<Q", first, 12, raw + hole)
        path.write_bytes(first)
        os.truncate(path, 28 + raw + hole)
    return path


def mdf(folder: Path, *, n: int, version="4.10", hole: bool = False) -> Path:
    """Write an MDF file whose channel group declares n records."""
    write_mdf(folder / "data.mf4", {"a": A})
    path = folder / "data.mf4"
    content = bytearray(path.read_bytes())
    group = content.index(b"##CG")
    links = struct.unpack_from("<Q", content, group + 16)[0]
    struct.pack_into("<Q", content, group + 24 + 8 * links + 8, n)
    if hole:  # the block of data is the last of the file, and as long
        block = content.rindex(b"##DT")
        size = struct.unpack_from("<Q", content, block + 8)[0]
        tail = content[block : block + size]
        struct.pack_into("<Q", tail, 8, 24 + 16 * n)
        data = content.index(b"##DG")
        struct.pack_into("<Q", content, data + 40, len(content))
        path.write_bytes(content + tail)
        os.truncate(path, len(content) + 24 + 16 * n)
    else:
        path.write_bytes(content)
    return path


def mdf_packed(folder: Path, *, size: int) -> Path:
    """Write an MDF file with a packed block that declares more than it holds."""
    asammdf = needed("asammdf")
    with asammdf.MDF(version="4.10") as file:
        zeros = np.zeros(10**5)
        file.append([asammdf.Signal(zeros, np.arange(len(zeros)) / 700, name="a")])
        written = file.save(folder / "new.mf4", overwrite=True, compression=1)
    content = bytearray(written.read_bytes())
    block = content.index(b"##DZ")
    struct.pack_into("<Q", content, block + 24 + 8, size)
    (folder / "data.mf4").write_bytes(content)
    written.unlink()
    return folder / "data.mf4"


def uff(folder: Path, *, n: int) -> Path:
    """Write a universal file whose record declares n values."""
    write_uff(folder / "data.uff", {"a": A})
    content = (folder / "data.uff").read_bytes()
    place = content.index(b"        50")
    text = f"{n:10d}".encode()[-10:]
    (folder / "data.uff").write_bytes(content[:place] + text + content[place + 10 :])
    return folder / "data.uff"


def csv_hole(folder: Path, *, text: str, size: int = 2**40) -> Path:
    """Write a CSV file that goes on with a hole."""
    (folder / "data.csv").write_text(text)
    os.truncate(folder / "data.csv", size)
    return folder / "data.csv"


# no files


def no_file(folder: Path, *, suffix: str, kind: str) -> Path:
    """Make something in the place of a data file that is none."""
    path = folder / f"data{suffix}"
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(path))
    elif kind == "loop":
        path.symlink_to(path)
    else:
        path.symlink_to(kind)
    return path


NOT_FILES = ("pipe", "folder", "socket", "loop", "/dev/zero", "/dev/random", "/dev/tty")
ROWS = "t,a\n" + "".join(f"{i},{i}\n" for i in range(40_000))
DECLARING = {
    "hdf5": partial(hdf5, shape=(10**11,)),
    "hdf5 in chunks": partial(hdf5, shape=(10**11,), chunks=(10**5,), compression="gzip"),
    "hdf5 of one piece": partial(hdf5, shape=(10**8,), chunks=(10**8,), compression="gzip"),
    "hdf5 notes": partial(hdf5_note, size=2**31 - 1),
    "mat 7.3": partial(hdf5, shape=(1, 10**11), suffix=".mat"),
    "mat": partial(mat, n=10**8),
    "mat packed": partial(mat, n=4 * 10**8, packed_bytes=3 * 2**30),
    "mat packed bytes": partial(mat, n=2 * 10**9, packed_bytes=2**31, kind=2),
    "mat packed matrix": partial(mat, n=10**8, rows=20, packed_bytes=2**31),
    "mat 4": partial(mat_4, n=6 * 10**7, columns=50),
    "parquet": partial(parquet, n=10**9),
    "parquet of columns": partial(parquet_columns, n_columns=2000),
    **{
        f"wav of {bits} bits": partial(wav, n_bytes=4 * 10**9, bits=bits, form=form)
        for bits, form in ((16, 1), (24, 1), (32, 3))
    },
    "uff": partial(uff, n=9 * 10**9),
    "tdms": partial(tdms, n=2**63),
    "tdms with a hole": partial(tdms, n=10**10, hole=8 * 10**10),
    "mdf": partial(mdf, n=10**11),
    "mdf with a hole": partial(mdf, n=10**10, hole=True),
    "mdf packed": partial(mdf_packed, size=10**15),
    "csv with a hole": partial(csv_hole, text=ROWS),
    "csv of one line": partial(csv_hole, text="1," * 10_000),
    **{f"{kind} as .csv": partial(no_file, suffix=".csv", kind=kind) for kind in NOT_FILES},
    "pipe as .mat": partial(no_file, suffix=".mat", kind="pipe"),
}
WITHIN_BOUNDS = ("mdf packed", "hdf5 notes", "parquet of columns")
"""Those in which a column may be read: what is there of it is no longer than recordings are."""
