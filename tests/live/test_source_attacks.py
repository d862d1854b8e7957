"""Files of others in a folder of frames are neither moved nor removed."""

import os
import socket
import stat

import pytest
from live_frames import encoded, frame

from suspnet.depot.live.drop_folder import DropFolder
from suspnet.trains.recordings.frames import encode

OURS = encoded(6)
GOOD = b"".join(OURS)
TEXT = b"time;value\n1;2\n"
FOREIGN = {
    "sqlite": b"SQLite format 3\0" + bytes(4080),
    "followed": GOOD + b"\n",
    "other_train_later": GOOD + encode(frame(0, suspension="train 7")),
}
NAMES = ("-rf", "a\n", "a\x1b[2J", "*.frames", "a" * 250, "ä", "~")


def tree(folder):
    """Return kind, size, content and target of all that lies below a folder."""
    found = {}
    for path in sorted(folder.rglob("*")):
        one = path.lstat()
        content = path.read_bytes() if stat.S_ISREG(one.st_mode) else None
        where = os.readlink(path) if stat.S_ISLNK(one.st_mode) else ""
        found[str(path.relative_to(folder))] = one.st_mode, one.st_size, content, where
    return found


@pytest.mark.parametrize("then", ["move", "delete"])
def test_nothing_in_a_full_folder_but_our_frames_is_touched(then, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (incoming := tmp_path / "incoming").mkdir()
    (outside := tmp_path / "outside").mkdir()
    (outside / "frames").write_bytes(GOOD)
    (incoming / "good.frames").write_bytes(GOOD)
    for name in ("0001.part", "..a"):  # not yet whole, or hidden
        (incoming / name).write_bytes(GOOD)
    for name, content in (dict.fromkeys(NAMES, TEXT) | FOREIGN).items():
        (incoming / name).write_bytes(content)
    for target in (outside / "frames", outside, outside / "none", "/dev/zero"):
        (incoming / f"to_{os.path.basename(target)}").symlink_to(target)
    (incoming / "to_itself").symlink_to(incoming / "to_itself")
    os.mkfifo(incoming / "fifo")
    with socket.socket(socket.AF_UNIX) as one:
        one.bind("incoming/socket")
    (incoming / "folder").mkdir(mode=0o755)
    (incoming / "folder" / "a.frames").write_bytes(GOOD)
    before = tree(tmp_path)
    source, frames = DropFolder(incoming, then=then, poll_s=0.01), []
    source.subscribe(["train 1, car 2"])
    for _ in range(20):
        frames += source.receive(0.02)
        source.confirm()
    source.close()
    after, good = tree(tmp_path), before.pop("incoming/good.frames")
    if then == "move":
        assert after.pop("incoming/taken/good.frames") == good
        after.pop("incoming/taken")
    assert after == before
    assert set(OURS) <= set(frames)
