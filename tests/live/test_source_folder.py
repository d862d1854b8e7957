"""Files of frames in a folder: read in the order of time, put away once they are kept."""

import os
import threading
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from live_frames import encoded, frame, numbers

from suspnet.live import drop_folder
from suspnet.live.drop_folder import DropFolder
from suspnet.stream import encode

FRAMES = encoded(30)


def opened(folder, **options):
    source = DropFolder(folder, **({"poll_s": 0.01, "once": True} | options))
    source.subscribe([])
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
    assert names(tmp_path / "refused") == []


def test_files_are_deleted_if_one_likes(tmp_path):
    (tmp_path / "a").write_bytes(FRAMES[0])
    (tmp_path / "b").write_bytes(b"foreign")
    source = opened(tmp_path, then="delete")
    assert everything(source) == FRAMES[:1]
    assert names(tmp_path) == names(tmp_path / "taken") == []
    assert names(tmp_path / "refused") == ["b"]


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
    os.mkfifo(tmp_path / "fifo")
    source = opened(tmp_path, once=False)
    assert source.receive(0.05) == []
    (tmp_path / "b.part").write_bytes(FRAMES[0])
    (tmp_path / "b.part").rename(tmp_path / "b")
    assert source.receive(5.0) == FRAMES[:1]
    assert source.counts == {}


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"time;value\n1;2\n", "foreign"),
        (b"", "truncated"),
        (FRAMES[0] + FRAMES[1][:-20], "truncated"),
        (FRAMES[0] + b"x" + FRAMES[1], "foreign"),
    ],
)
def test_file_with_anything_but_frames_is_refused_after_its_frames(tmp_path, content, reason):
    (tmp_path / "bad").write_bytes(content)
    (tmp_path / "good").write_bytes(FRAMES[5])
    source = opened(tmp_path)
    expected = [one for one in FRAMES[:2] if one in content] + [FRAMES[5]]
    assert sorted(everything(source)) == sorted(expected)
    assert source.counts == {reason: 1}
    assert names(tmp_path / "refused") == ["bad"]
    assert names(tmp_path / "taken") == ["good"]


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.lists(
            st.one_of(st.sampled_from(FRAMES), st.binary(min_size=1, max_size=40)), max_size=5
        ),
        max_size=5,
    )
)
def test_files_of_anything_give_their_frames_and_are_put_away(contents):
    with TemporaryDirectory() as name:
        folder = Path(name)
        for k, parts in enumerate(contents):
            (folder / str(k)).write_bytes(b"".join(parts))
        found = everything(opened(folder))
        assert sorted(found) == sorted(p for parts in contents for p in parts if p in FRAMES)
        whole = [str(k) for k, parts in enumerate(contents) if parts and set(parts) <= set(FRAMES)]
        assert names(folder) == []
        assert names(folder / "taken") == whole
        assert len(names(folder / "refused")) == len(contents) - len(whole)


def test_files_are_put_away_as_their_frames_are_confirmed_one_after_the_other(tmp_path):
    (tmp_path / "a").write_bytes(b"".join(FRAMES[:2]))
    (tmp_path / "b").write_bytes(b"".join(FRAMES[2:5]))
    source = opened(tmp_path, once=False)
    assert source.receive(1.0) == FRAMES[:5]
    (tmp_path / "c").write_bytes(b"foreign")
    assert source.receive(0.05) == []
    source.confirm(1)
    assert names(tmp_path) == ["a", "b", "c"]
    source.confirm(3)
    assert names(tmp_path) == ["b", "c"]
    source.confirm(1)
    assert names(tmp_path) == []
    assert names(tmp_path / "taken") == ["a", "b"]
    (tmp_path / "d").write_bytes(b"foreign")
    assert source.receive(0.05) == []
    source.confirm(0)
    assert names(tmp_path / "refused") == ["c", "d"]


def test_thousands_of_files_and_batches_of_bounded_size(tmp_path, monkeypatch):
    monkeypatch.setattr(drop_folder, "BATCH_BYTES", 20 * len(FRAMES[0]))
    frames = encoded(2000)
    for k, one in enumerate(frames):
        (tmp_path / f"{k:04d}").write_bytes(one)
    source = opened(tmp_path)
    found = []
    while (part := source.receive(1.0)) is not None:
        assert len(part) <= 20
        found += part
        source.confirm()
    assert found == frames
    assert len(names(tmp_path / "taken")) == 2000


def test_large_file_comes_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr(drop_folder, "PIECE_BYTES", 1000)
    monkeypatch.setattr(drop_folder, "BATCH_BYTES", 3000)
    (tmp_path / "large").write_bytes(b"".join(FRAMES))
    source = opened(tmp_path)
    first = source.receive(1.0)
    assert 0 < len(first) < 10
    source.confirm()
    assert names(tmp_path) == ["large"]
    assert first + everything(source) == FRAMES
    assert names(tmp_path / "taken") == ["large"]


def test_files_that_vanish_or_cannot_be_read_are_counted(tmp_path, monkeypatch):
    for k in range(4):
        (tmp_path / str(k)).write_bytes(FRAMES[k])
    source = opened(tmp_path)
    source._look()
    (tmp_path / "1").unlink()
    (tmp_path / "2").unlink()
    (tmp_path / "2").mkdir()
    found = source.receive(1.0)
    (tmp_path / "3").unlink()
    assert found + everything(source) == [FRAMES[0], FRAMES[3]]
    assert source.counts == {"vanished": 2, "unreadable": 1}
    assert names(tmp_path / "taken") == ["0"]


def test_folder_that_vanishes_is_counted_and_may_return(tmp_path):
    folder = tmp_path / "drop"
    folder.mkdir()
    source = opened(folder, once=False)
    folder.rename(tmp_path / "away")
    assert source.receive(0.05) == []
    assert source.counts["vanished"] > 0
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
    assert source.counts == {"replaced": 1}
    assert names(tmp_path / "taken") == ["a"]


def test_folder_is_looked_at_no_oftener_than_it_was_told(tmp_path, monkeypatch):
    source, n_looks, look = opened(tmp_path, once=False, poll_s=60.0), [], DropFolder._look
    monkeypatch.setattr(DropFolder, "_look", lambda self: (n_looks.append(1), look(self)))
    for _ in range(10):
        assert source.receive(0.002) == []
    assert len(n_looks) == 1


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


def test_frames_of_several_sensors_are_merged_by_the_time_of_files(tmp_path):
    for sensor in ("body", "bogie"):
        for k in range(3):
            data = encode(frame(k, sensor=sensor))
            (tmp_path / f"{sensor}_{k}").write_bytes(data)
    found = [one[2] for one in numbers(everything(opened(tmp_path)))]
    assert found == [0, 0, 1, 1, 2, 2]
