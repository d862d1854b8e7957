"""Data files that would run code, or read or fetch other files, if their readers did what they say.

Each function of ``ACTING`` writes a file into a folder. ``canary`` there must never exist;
``secret`` and ``secret.mat`` hold what must never come in as samples.
"""

import pickle
import struct
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from recording_files import hdf5_file, needed, write_tdms
from scipy.io import savemat

from suspnet.trains.recordings.formats import FORMATS

SUFFIXES = [".csv", *(suffixes[0] for suffixes in FORMATS)]
SECRET = 42.625
"""Value of each sample of ``secret.mat``; ``secret`` holds its bytes."""
A = np.arange(50.0)
TOUCH = "__import__('os').system('touch {canary}')"
FORMULAS = {
    "system": TOUCH,
    "system of X1": f"X1 + {TOUCH}",
    "system of X": f"X * 0 + {TOUCH}",
    "subprocess": "__import__('subprocess').call(['touch', '{canary}']) + X",
    "open": "open('{canary}', 'w').write('x')",
    "eval": 'eval("{touch}")',
    "exec": 'exec(\'open("{canary}", "w")\')',
    "lambda": "(lambda: {touch})()",
    "list": "[{touch} for x in (1,)][0]",
    "subclasses": "().__class__.__base__.__subclasses__()[0] and {touch}",
    "read": "open('{folder}/secret', 'rb').read()[0] + 0 * X",
    "numexpr": "sin(X) + ({touch})",
    "walrus": "(y := {touch})",
    "conditional": "X if {touch} else X",
    "tower": "9**9**9**9**9",
    "deep": "(" * 5000 + "X" + ")" * 5000,
    "innocent": "2 * X1 + 1",
}


def prepare(folder: Path) -> None:
    """Write what must not be read into a folder."""
    (folder / "secret").write_bytes(np.full(200, SECRET).tobytes())
    savemat(folder / "secret.mat", {"x": np.full(200, SECRET)})


def formula(folder: Path, text: str) -> str:
    """Return the text of a formula for a folder."""
    canary = str(folder / "canary")
    touch = TOUCH.format(canary=canary)
    return (
        text.replace("{touch}", touch).replace("{canary}", canary).replace("{folder}", str(folder))
    )


# MDF


def mdf(folder: Path, *, text=FORMULAS["system"], version="4.10", place="value", kind="f8") -> Path:
    """Write an MDF file with a formula at some place."""
    asammdf = needed("asammdf")
    text = formula(folder, text)
    if version < "4":
        from asammdf.blocks.v2_v3_blocks import ChannelConversion

        conversion = ChannelConversion(conversion_type=10, formula=text)
    else:
        from asammdf.blocks.v4_blocks import ChannelConversion

        conversion = ChannelConversion(conversion_type=3, formula=text)
        table = {"conversion_type": 8 if place == "range" else 7, "ref_param_nr": 2}
        table |= {"val_0": 1.0, "lower_0": 0.0, "upper_0": 9.0}
        if place in ("text", "range"):
            conversion = ChannelConversion(**table, text_0=conversion)
        elif place == "default":
            conversion = ChannelConversion(**table, text_0=b"x", default_addr=conversion)
    with asammdf.MDF(version=version) as file:
        for group in range(2 if place == "second group" else 1):
            name = "a" if group == 0 else "b"
            file.append([asammdf.Signal(A.astype(kind), A / 10, name=name, unit="g")])
        places = {"master": [0], "both": [0, 1]}.get(place, [1])
        for i in places:
            file.groups[-1].channels[i].conversion = conversion
        written = file.save(folder / f"new.{'mf4' if version >= '4' else 'mdf'}", overwrite=True)
    path = folder / ("data.mf4" if version >= "4" else "data.mdf")
    written.rename(path)
    return path


def mdf_comment(folder: Path, text: str) -> Path:
    """Write an MDF file with XML as the comment of the file and of the channel."""
    asammdf = needed("asammdf")
    text = text.replace("{folder}", str(folder))
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(A, A / 10, name="a", unit="g", comment=text)])
        file.header.comment = text
        written = file.save(folder / "new.mf4", overwrite=True)
    return written.rename(folder / "data.mf4")


def mdf_attachment(folder: Path, *, embedded: bool) -> Path:
    """Write an MDF file with an attachment that is a script, or another file."""
    asammdf = needed("asammdf")
    with asammdf.MDF(version="4.10") as file:
        file.append([asammdf.Signal(A, A / 10, name="a", unit="g")])
        script = f"#!/bin/sh\ntouch {folder}/canary\n".encode()
        name = "run.sh" if embedded else str(folder / "secret")
        file.attach(script, file_name=name, embedded=embedded) if embedded else file.attach(
            (folder / "secret").read_bytes(), file_name=name, embedded=False
        )
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


def external(_, file, folder, name="{folder}/secret", shape=(200,)):
    parts = [(name.format(folder=folder), 0, 8 * int(np.prod(shape)))]
    file.create_dataset("a", shape, dtype="f8", external=parts)


def virtual(h5py, file, folder, source="{folder}/secret.h5"):
    layout = h5py.VirtualLayout((200,), "f8")
    layout[:] = h5py.VirtualSource(source.format(folder=folder), "x", (200,))
    file.create_virtual_dataset("a", layout)


def link(h5py, file, folder, target):
    file["b"] = h5py.ExternalLink(str(folder / "secret.h5"), target)
    file["a"] = h5py.SoftLink("/b/x" if target == "/" else "/b")


def plugin(h5py, file, _, number=32001):
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_chunk((50,))
    plan.set_filter(number, h5py.h5z.FLAG_OPTIONAL, (1, 2))
    space = h5py.h5s.create_simple((50,))
    h5py.h5d.create(file.id, b"a", h5py.h5t.NATIVE_DOUBLE, space, plan)
    h5py.Dataset(file["a"].id).id.write_direct_chunk((0,), A.tobytes())


# MAT, TDMS, Parquet and others


def mat_class(folder: Path, number: int) -> Path:
    """Write a MAT file with a variable that is an object, a function handle or opaque."""

    def element(kind, content):
        return struct.pack("<II", kind, len(content)) + content.ljust(
            -(-len(content) // 8) * 8, b"\0"
        )

    code = formula(folder, "@() system('touch {canary}')").encode()
    parts = (element(6, struct.pack("<II", 4, 0)), element(5, struct.pack("<ii", 1, len(code))))
    inner = element(14, b"".join((*parts, element(1, b""), element(16, code))))
    head = element(6, struct.pack("<II", number, 0))
    if number == 17:
        body = head + element(1, b"a") + element(1, b"MCOS") + element(1, b"evil") + inner
    else:
        body = head + element(5, struct.pack("<ii", 1, 1)) + element(1, b"a")
        if number == 3:
            body += (
                element(1, b"evil")
                + element(5, struct.pack("<i", 8))
                + element(1, b"f".ljust(8, b"\0"))
            )
        body += inner
    path = folder / "data.mat"
    head = b"MATLAB 5.0 MAT-file".ljust(116) + bytes(8) + struct.pack("<H", 0x0100) + b"IM"
    path.write_bytes(head + element(14, body))
    return path


class Trap:
    """Writes the canary if it is unpickled."""

    def __init__(self, folder: Path):
        self.canary = str(folder / "canary")

    def __reduce__(self):
        return open, (self.canary, "w")


def pickled(folder: Path, suffix: str) -> Path:
    path = folder / f"data{suffix}"
    path.write_bytes(pickle.dumps(Trap(folder)))
    return path


def mat_pickle(folder: Path) -> Path:
    savemat(folder / "data.mat", {"a": pickle.dumps(Trap(folder)), "s": {"x": [Trap]} and "text"})
    return folder / "data.mat"


def tdms(folder: Path, *, index=False, scale="") -> Path:
    """Write a TDMS file: with the index of another file beside it, or a scale that is code."""
    nptdms = needed("nptdms")
    path = folder / "data.tdms"
    properties = {}
    if scale:
        code = formula(folder, TOUCH)
        properties = {"NI_Number_Of_Scales": 1, "NI_Scale[0]_Scale_Type": scale}
        properties |= {"NI_Scale[0]_Formula": code, f"NI_Scale[0]_{scale}": code}
    with nptdms.TdmsWriter(path) as writer:
        writer.write_segment([nptdms.ChannelObject("g", "a", A, properties=properties)])
    if index:
        write_tdms(folder / "other.tdms", {"secret": np.full(50, SECRET)})
        (folder / "other.tdms").rename(folder / "data.tdms_index")
    return path


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


def linked(folder: Path, suffix: str) -> Path:
    """Write a link to the secret in the place of a data file."""
    (folder / f"data{suffix}").symlink_to(folder / "secret")
    return folder / f"data{suffix}"


LAUGHS = "".join(f"<!ENTITY a{i} '{f'&a{i - 1};' * 10}'>" for i in range(1, 12))
XML = {
    "laughs": f"<!DOCTYPE x [<!ENTITY a0 'ha'>{LAUGHS}]><HDcomment><TX>&a11;</TX></HDcomment>",
    "entity": "<!DOCTYPE x [<!ENTITY s SYSTEM 'file://{folder}/secret'>]><CNcomment><TX>&s;</TX></CNcomment>",
}
ACTING = {
    **{f"mdf {name}": partial(mdf, text=text) for name, text in FORMULAS.items()},
    **{
        f"mdf at {place}": partial(mdf, place=place)
        for place in ("master", "both", "second group", "default", "text", "range")
    },
    **{f"mdf of {kind}": partial(mdf, kind=kind) for kind in ("u1", "i4", "f4")},
    **{
        f"mdf {version}": partial(mdf, version=version)
        for version in ("4.00", "4.20", "3.30", "3.20")
    },
    **{f"mdf xml {name}": partial(mdf_comment, text=text) for name, text in XML.items()},
    "mdf attachment": partial(mdf_attachment, embedded=True),
    "mdf other file": partial(mdf_attachment, embedded=False),
    **{
        f"hdf5 external {name}": partial(hdf5, fill=partial(external, **how))
        for name, how in {
            "file": {},
            "relative": {"name": "secret"},
            "matrix": {"shape": (100, 2)},
            "passwords": {"name": "/etc/passwd", "shape": (20,)},
        }.items()
    },
    "mat 7.3 external": partial(hdf5, fill=external, suffix=".mat"),
    **{
        f"hdf5 virtual {source}": partial(hdf5, fill=partial(virtual, source=source))
        for source in ("{folder}/secret.h5", "secret.h5", "{folder}/secret.h5%%", ".", "absent.h5")
    },
    **{
        f"hdf5 link {target}": partial(hdf5, fill=partial(link, target=target))
        for target in ("/", "/x")
    },
    **{
        f"hdf5 plug-in {number}": partial(hdf5, fill=partial(plugin, number=number))
        for number in (305, 32001, 65535)
    },
    **{f"mat class {number}": partial(mat_class, number=number) for number in (3, 16, 17)},
    "mat pickle": mat_pickle,
    **{f"pickle as {suffix}": partial(pickled, suffix=suffix) for suffix in SUFFIXES},
    "tdms index": partial(tdms, index=True),
    **{
        f"tdms {scale}": partial(tdms, scale=scale)
        for scale in ("Formula", "Python", "Add", "Table")
    },
    "parquet extension": parquet_extension,
    "parquet path": parquet_path,
    "csv": csv,
    **{f"link as {suffix}": partial(linked, suffix=suffix) for suffix in SUFFIXES},
}
HARMLESS = (
    *("mdf xml laughs", "mdf xml entity", "mdf attachment", "mdf other file"),
    *("tdms index", "tdms Formula", "tdms Python", "tdms Add", "tdms Table", "parquet extension"),
    *("mdf at second group", "mdf at master", "csv"),
)
"""Those in which a column may be read, as what would act is beside it and ignored."""
