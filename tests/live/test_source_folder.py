"""Files of frames in a folder: read in the order of time, put away once they are kept."""

import os
import threading
import time

import pytest
from live_frames import encoded, frame, numbers

from suspnet.depot.live.drop_folder import DropFolder
from suspnet.trains.recordings.frames import encode

FRAMES = encoded(30)


def opened(folder, **options):
    source = DropFolder(folder, **({"poll_s": 0.01, "once": True} | options))
    source.subscribe(["train 1, car 2"])
    return source


def everything(source):
    """Return all frames of a source that ends, each batch confirmed."""
    found = []
    while (part := source.receive(1.0)) is not None:
        found += part
        source.confirm()
    source.confirm()
    return found


def names(folder):
    return sorted(path.name for path in folder.iterdir() if path.is_file())


def test_files_are_read_in_the_order_of_their_first_frames(tmp_path):
    for k in range(10):
        (tmp_path / f"{9 - k}.frames").write_bytes(b"".join(FRAMES[3 * k : 3 * k + 3]))
    assert everything(opened(tmp_path)) == FRAMES
    assert names(tmp_path) == []
    assert len(names(tmp_path / "taken")) == 10


def test_file_stays_until_its_frames_are_confirmed(tmp_path):
    (tmp_path / "a").write_bytes(b"".join(FRAMES))
    source = opened(tmp_path, once=False)
    assert source.receive(1.0) == FRAMES
    assert source.receive(0.05) == []
    source.close()
    assert names(tmp_path) == ["a"]
    again = opened(tmp_path)
    assert everything(again) == FRAMES
    assert names(tmp_path / "taken") == ["a"]


def test_files_that_are_being_written_are_left_alone(tmp_path):
    for name in (".a", "b.part", "c.tmp"):
        (tmp_path / name).write_bytes(FRAMES[0][:100])
    (tmp_path / "folder").mkdir()
    source = opened(tmp_path, once=False)
    assert source.receive(0.05) == []
    (tmp_path / "b.part").write_bytes(FRAMES[0])
    (tmp_path / "b.part").rename(tmp_path / "b")
    assert source.receive(5.0) == FRAMES[:1]
    assert source.counts == {}


@pytest.mark.representatives(4)
@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "does not start with a frame"),
        (b"x" + FRAMES[0], "does not start with a frame"),
        (FRAMES[0] + FRAMES[1][:-20], f"damaged at byte {len(FRAMES[0])}"),
        (FRAMES[0] + b"x" + FRAMES[1], f"damaged at byte {len(FRAMES[0])}"),
        (encode(frame(0, suspension="train 9")), "'train 9', which is not monitored here"),
        (FRAMES[0].replace(b"sequence", b"seqvence"), "not valid (sequence)"),
    ],
)
def test_file_with_anything_but_our_frames_is_left_and_reported_once(
    tmp_path, caplog, content, reason
):
    (tmp_path / "bad\x1b[2J").write_bytes(content)
    (tmp_path / "good").write_bytes(FRAMES[5])
    source = opened(tmp_path, once=False)
    found = source.receive(0.1) + source.receive(0.1)
    source.confirm()
    begins = content.startswith(b"\xff")
    assert [one for one in found if one in FRAMES] == [
        *(one for one in FRAMES[:2] if begins and one in content),
        FRAMES[5],
    ]
    assert source.counts == {"left": 1}
    assert names(tmp_path) == ["bad\x1b[2J"]
    assert (tmp_path / "bad\x1b[2J").read_bytes() == content
    assert names(tmp_path / "taken") == ["good"]
    (words,) = [record.getMessage() for record in caplog.records]
    assert reason in words
    assert words.isprintable()


def test_files_are_not_moved_through_a_link(tmp_path):
    (tmp_path / "outside").mkdir()
    folder = tmp_path / "incoming"
    folder.mkdir()
    (folder / "a").write_bytes(FRAMES[0])
    (folder / "taken").symlink_to(tmp_path / "outside")
    with pytest.raises(OSError, match="must be a folder, not a link"):
        opened(folder)
    (folder / "taken").unlink()
    source = opened(folder)
    assert source.receive(1.0) == FRAMES[:1]
    (folder / "taken").symlink_to(tmp_path / "outside")
    source.confirm()
    assert os.listdir(tmp_path / "outside") == []
    assert sorted(os.listdir(folder)) == ["a", "taken"]


def test_file_that_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "long").open("wb") as file:
        file.write(FRAMES[0])
        file.truncate(10**12)  # sparse
    assert everything(opened(tmp_path)) == []
    assert names(tmp_path) == ["long"]


def test_files_are_put_away_as_their_frames_are_confirmed_one_after_the_other(tmp_path):
    (tmp_path / "a").write_bytes(b"".join(FRAMES[:2]))
    (tmp_path / "b").write_bytes(b"".join(FRAMES[2:5]))
    source = opened(tmp_path, once=False)
    assert source.receive(1.0) + source.receive(1.0) == FRAMES[:5]
    source.confirm(1)
    assert names(tmp_path) == ["a", "b"]
    source.confirm(3)
    assert names(tmp_path) == ["b"]
    source.confirm(1)
    assert names(tmp_path) == []
    assert names(tmp_path / "taken") == ["a", "b"]


def test_files_that_vanish_or_cannot_be_read_are_counted(tmp_path):
    for k in range(4):
        (tmp_path / str(k)).write_bytes(FRAMES[k])
    source = opened(tmp_path)
    assert source.receive(1.0) == FRAMES[:1]
    (tmp_path / "1").unlink()
    (tmp_path / "2").unlink()
    (tmp_path / "2").mkdir()
    assert source.receive(1.0) == FRAMES[3:4]
    (tmp_path / "3").unlink()
    source.confirm()
    assert source.counts == {"left": 3}
    assert names(tmp_path / "taken") == ["0"]


def test_folder_that_vanishes_is_counted_and_may_return(tmp_path):
    folder = tmp_path / "drop"
    folder.mkdir()
    source = opened(folder, once=False)
    folder.rename(tmp_path / "away")
    assert source.receive(0.05) == []
    assert source.counts["unreachable"] > 0
    (tmp_path / "away").rename(folder)
    (folder / "a").write_bytes(FRAMES[0])
    assert source.receive(5.0) == FRAMES[:1]


def test_file_of_a_name_that_was_taken_keeps_both(tmp_path):
    for k in range(3):
        (tmp_path / "a.frames").write_bytes(FRAMES[k])
        assert everything(opened(tmp_path)) == [FRAMES[k]]
    assert names(tmp_path / "taken") == ["a.frames", "a_2.frames", "a_3.frames"]


def test_file_that_is_replaced_before_it_is_confirmed_is_read_anew(tmp_path):
    (tmp_path / "a").write_bytes(FRAMES[0])
    source = opened(tmp_path, once=False)
    assert source.receive(1.0) == FRAMES[:1]
    (tmp_path / "b.tmp").write_bytes(FRAMES[1])
    (tmp_path / "b.tmp").rename(tmp_path / "a")
    source.confirm()
    assert source.receive(5.0) == FRAMES[1:2]
    source.confirm()
    assert names(tmp_path / "taken") == ["a"]


def test_receive_waits_for_files_no_longer_than_it_was_told(tmp_path):
    source = opened(tmp_path, once=False)
    begin = time.monotonic()
    assert source.receive(0.1) == []
    assert 0.05 < time.monotonic() - begin < 2
    threading.Timer(0.1, (tmp_path / "a").write_bytes, [FRAMES[0]]).start()
    assert numbers(source.receive(5.0)) == [("train 1, car 2", "body", 0)]


def test_folder_that_is_not_there_is_a_mistake(tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no such folder"):
        DropFolder(tmp_path / "x").subscribe([])
    with pytest.raises(ValueError, match="`then` must be one of"):
        DropFolder(tmp_path, then="burn")
    with pytest.raises(TypeError, match="`once` must be True or False"):
        DropFolder(tmp_path, once="yes")
