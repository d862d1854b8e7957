"""Data files that would run code, or read or fetch other files, if their readers did what they say.

Each function of ``ACTING`` writes a file into a folder. ``canary`` there must never exist;
``secret`` and ``secret.mat`` hold what must never come in as samples.
"""

import pickle
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from recording_files import hdf5_file, needed, write_tdms
from scipy.io import savemat

SECRET = 42.625
"""Value of each sample of ``secret.mat``; ``secret`` holds its bytes."""
A = np.arange(50.0)
TOUCH = "__import__('os').system('touch {canary}')"
FORMULAS = {
    "system": TOUCH,
    "read": "open('{folder}/secret', 'rb').read()[0] + 0 * X",
    "tower": "9**9**9**9**9",
}


def prepare(folder: Path) -> None:
    """Write what must not be read into a folder."""
    (folder / "secret").write_bytes(np.full(200, SECRET).tobytes())
    savemat(folder / "secret.mat", {"x": np.full(200, SECRET)})


def formula(folder: Path, text: str) -> str:
    """Return the text of a formula for a folder."""
    return text.replace("{canary}", str(folder / "canary")).replace("{folder}", str(folder))


# MDF


def mdf(folder: Path, *, text=FORMULAS["system"], version="4.10", in_range=False) -> Path:
    """Write an MDF file whose channel has a formula, or one for a range of its values."""
    asammdf = needed("asammdf")
    text = formula(folder, text)
    if version < "4":
        from asammdf.blocks.v2_v3_blocks import ChannelConversion

        conversion = ChannelConversion(conversion_type=10, formula=text)
    else:
        from asammdf.blocks.v4_blocks import ChannelConversion

        conversion = ChannelConversion(conversion_type=3, formula=text)
        if in_range:
            table = {"ref_param_nr": 2, "val_0": 1.0, "lower_0": 0.0, "upper_0": 9.0}
            conversion = ChannelConversion(conversion_type=8, **table, text_0=conversion)
    with asammdf.MDF(version=version) as file:
        file.append([asammdf.Signal(A, A / 10, name="a", unit="g")])
        file.groups[-1].channels[1].conversion = conversion
        written = file.save(folder / f"new.{'mf4' if version >= '4' else 'mdf'}", overwrite=True)
    return written.rename(folder / f"data{written.suffix}")


def mdf_comment(folder: Path, text: str) -> Path:
    """Write an MDF file with XML as the comment of the file and of the channel."""
    asammdf = needed("asammdf")
    text = text.replace("{folder}", str(folder))
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(A, A / 10, name="a", unit="g", comment=text)])
        file.header.comment = text
        written = file.save(folder / "new.mf4", overwrite=True)
    return written.rename(folder / "data.mf4")


def mdf_attachment(folder: Path) -> Path:
    """Write an MDF file with an attachment that is a script."""
    asammdf = needed("asammdf")
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(A, A / 10, name="a", unit="g")])
        file.attach(f"#!/bin/sh\ntouch {folder}/canary\n".encode(), file_name="run.sh")
        written = file.save(folder / "new.mf4", overwrite=True)
    return written.rename(folder / "data.mf4")


# HDF5


def hdf5(folder: Path, fill, suffix=".h5") -> Path:
    """Write an HDF5 file that a function fills, and ``secret.h5`` beside it."""
    h5py = needed("h5py")
    with h5py.File(folder / "secret.h5", "w") as file:
        file["x"] = np.full(200, SECRET)
    with hdf5_file(folder / f"data{suffix}") as file:
        fill(h5py, file, folder)
    return folder / f"data{suffix}"


def external(_, file, folder):
    file.create_dataset("a", (200,), dtype="f8", external=[(str(folder / "secret"), 0, 1600)])


def virtual(h5py, file, _):
    layout = h5py.VirtualLayout((200,), "f8")
    layout[:] = h5py.VirtualSource("secret.h5", "x", (200,))
    file.create_virtual_dataset("a", layout)


def link(h5py, file, folder):
    file["b"] = h5py.ExternalLink(str(folder / "secret.h5"), "/x")
    file["a"] = h5py.SoftLink("/b")


def plugin(h5py, file, _):
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((50,))
    plan.set_filter(32001, h5py.h5z.FLAG_OPTIONAL, (1, 2))
    space = h5py.h5s.create_simple((50,))
    h5py.h5d.create(file.id, b"a", h5py.h5t.NATIVE_DOUBLE, space, plan)
    h5py.Dataset(file["a"].id).id.write_direct_chunk((0,), A.tobytes())


# TDMS, Parquet and others


class Trap:
    """Writes the canary if it is unpickled."""

    def __init__(self, folder: Path):
        self.canary = str(folder / "canary")

    def __reduce__(self):
        return open, (self.canary, "w")


def tdms(folder: Path) -> Path:
    """Write a TDMS file with a scale that is code."""
    nptdms = needed("nptdms")
    code = formula(folder, TOUCH)
    properties = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": "Formula"}
    properties |= {"NI_Scale[0]_Formula": code}
    with nptdms.TdmsWriter(folder / "data.tdms") as writer:
        writer.write_segment([nptdms.ChannelObject("g", "a", A, properties=properties)])
    return folder / "data.tdms"


def tdms_index(folder: Path) -> Path:
    """Write a TDMS file with the index of another file beside it."""
    write_tdms(folder / "data.tdms", {"a": A})
    write_tdms(folder / "other.tdms", {"secret": np.full(50, SECRET)})
    (folder / "other.tdms").rename(folder / "data.tdms_index")
    return folder / "data.tdms"


def parquet_extension(folder: Path) -> Path:
    """Write a Parquet file whose schema holds a pickled type."""
    said = {b"ARROW:extension:name": b"arrow.py_extension_type"}
    said[b"ARROW:extension:metadata"] = pickle.dumps(Trap(folder))
    field = pa.field("a", pa.float64(), metadata=said)
    pq.write_table(pa.table([A], schema=pa.schema([field])), folder / "data.parquet")
    return folder / "data.parquet"


def parquet_path(folder: Path) -> Path:
    """Write a Parquet file that says its columns lie in another one."""
    secret = folder / "secret.parquet"
    pq.write_table(pa.table({"a": np.full(50, SECRET)}), secret)
    seen: list = []
    pq.write_table(pa.table({"a": np.full(50, SECRET)}), secret, metadata_collector=seen)
    seen[0].set_file_path("secret.parquet")
    seen[0].write_metadata_file(folder / "data.parquet")
    return folder / "data.parquet"


def csv(folder: Path) -> Path:
    text = formula(folder, "=cmd|'touch {canary}'!A1")
    (folder / "data.csv").write_text(f"t,a\n0,1\n1,2\n2,{text}\n")
    return folder / "data.csv"


def linked(folder: Path) -> Path:
    """Write a link to the secret in the place of a data file."""
    (folder / "data.mat").symlink_to(folder / "secret")
    return folder / "data.mat"


LAUGHS = "".join(f"<!ENTITY a{i} '{f'&a{i - 1};' * 10}'>" for i in range(1, 12))
XML = {
    "laughs": f"<!DOCTYPE x [<!ENTITY a0 'ha'>{LAUGHS}]><HDcomment><TX>&a11;</TX></HDcomment>",
    "entity": "<!DOCTYPE x [<!ENTITY s SYSTEM 'file://{folder}/secret'>]><CNcomment><TX>&s;</TX></CNcomment>",
}
ACTING = {
    **{f"mdf {name}": partial(mdf, text=text) for name, text in FORMULAS.items()},
    "mdf in a range": partial(mdf, in_range=True),
    "mdf 3.30": partial(mdf, version="3.30"),
    **{f"mdf xml {name}": partial(mdf_comment, text=text) for name, text in XML.items()},
    "mdf attachment": mdf_attachment,
    **{
        f"hdf5 {fill.__name__}": partial(hdf5, fill=fill)
        for fill in (external, virtual, link, plugin)
    },
    "mat 7.3 external": partial(hdf5, fill=external, suffix=".mat"),
    "tdms formula": tdms,
    "tdms index": tdms_index,
    "parquet extension": parquet_extension,
    "parquet path": parquet_path,
    "csv": csv,
    "link": linked,
}
HARMLESS = (
    *("mdf xml laughs", "mdf xml entity", "mdf attachment", "tdms index", "tdms formula"),
    *("parquet extension", "csv"),
)
"""Those in which a column may be read, as what would act is beside it and ignored."""
