"""Files of others in a folder of frames are neither moved nor removed."""

import os
import socket
import stat

import numpy as np
import pytest
from live_frames import encoded, frame

from suspnet.depot.live.drop_folder import DropFolder
from suspnet.trains.recordings.frames import encode

OURS = encoded(6)
GOOD = b"".join(OURS)
FOREIGN = {
    "text": b"time;value\n1;2\n",
    "marks": b"\xff\xff\xff\xff" * 500,
    "sqlite": b"SQLite format 3\0" + bytes(4080),
    "parquet": b"PAR1" + bytes(100) + b"PAR1",
    "preceded": b"\n" + GOOD,
    "followed": GOOD + b"\n",
    "other_column": OURS[0].replace(b"samples", b"simples"),
    "without_number": OURS[0].replace(b"sequence", b"seqvence"),
    "other_train": encode(frame(0, suspension="train 7, car 2")),
    "like_ours": encode(frame(0, suspension="train 1, car 2 ")),
    "other_train_later": GOOD + encode(frame(0, suspension="train 7")),
    "not_a_number": encode(frame(0, n=100, samples=np.full(100, 7.0))).replace(
        np.full(100, 7.0).tobytes(), np.full(100, np.nan).tobytes()
    ),
}
NAMES = ("-rf", "a\n", "a\x1b[2J", "*.frames", "a" * 250, "ä", "0001.part.frames", "..a", "~")
LINKS = ("to_frames", "to_folder", "to_nothing", "to_itself", "to_device")
OTHERS = ("fifo", "socket", "folder_of_frames", "unreadable_folder")


def lie(folder, name):
    """Put something that is none of our files into a folder; return its path, or None."""
    kind, _, which = name.partition(":")
    path = folder / which
    if kind == "name":
        if which.startswith("..") or which.endswith(".part"):
            path.write_bytes(GOOD)  # hidden, or not yet whole
        else:
            path.write_bytes(FOREIGN["text"])
    elif kind == "content":
        path.write_bytes(FOREIGN[which])
    elif kind == "link":
        outside = folder.parent / "outside"
        targets = {"to_frames": outside / "frames", "to_folder": outside, "to_itself": path}
        targets |= {"to_nothing": outside / "none", "to_device": "/dev/zero"}
        path.symlink_to(targets[which])
    elif which == "fifo":
        os.mkfifo(path)
    elif which == "socket":
        with socket.socket(socket.AF_UNIX) as one:
            one.bind(os.path.relpath(path))
    else:
        path.mkdir(mode=0 if which == "unreadable_folder" else 0o755)
        if which == "folder_of_frames":
            (path / "a.frames").write_bytes(GOOD)


def tree(folder):
    """Return kind, size, time and content of all that lies below a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        one = path.lstat()
        content = path.read_bytes() if stat.S_ISREG(one.st_mode) else None
        where = os.readlink(path) if stat.S_ISLNK(one.st_mode) else ""
        found[str(path.relative_to(folder))] = one.st_mode, one.st_size, content, where
    return found


IN_FOLDER = [
    *(f"name:{name}" for name in NAMES),
    *(f"content:{name}" for name in FOREIGN),
    *(f"link:{name}" for name in LINKS),
    *(f"other:{name}" for name in OTHERS),
]


def laid(folder):
    """Make a folder of frames with one good file in it, and what lies outside of it."""
    (incoming := folder / "incoming").mkdir()
    (incoming / "good.frames").write_bytes(GOOD)
    (outside := folder / "outside").mkdir()
    for name, content in (("text", b"precious"), ("frames", GOOD), (".hidden", GOOD)):
        (outside / name).write_bytes(content)
    return incoming


def all_read(incoming, then):
    """Read a folder until nothing new comes, all confirmed; return the source and its frames."""
    source = DropFolder(incoming, then=then, poll_s=0.01)
    source.subscribe(["train 1, car 2"])
    found = []
    for _ in range(20):
        found += source.receive(0.02)
        source.confirm()
    source.close()
    return source, found


def only_good_is_gone(before, after, then):
    """Assert that nothing has changed but the one file of frames, which is moved or deleted."""
    good = before.pop("incoming/good.frames")
    if then == "move":
        assert after.pop("incoming/taken/good.frames") == good
        after.pop("incoming/taken")
    assert after == before


@pytest.mark.parametrize("then", ["move", "delete"])
def test_nothing_in_a_full_folder_but_our_frames_is_touched(then, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    incoming = laid(tmp_path)
    for name in IN_FOLDER:
        lie(incoming, name)
    before = tree(tmp_path)
    _, frames = all_read(incoming, then)
    only_good_is_gone(before, tree(tmp_path), then)
    assert set(OURS) <= set(frames)
