"""suspnet-replay from the command line, into a folder."""

import pytest
from cli_runner import typed
from live_frames import frame
from trip_fixtures import changed, write_trips

from suspnet.cli import replay
from suspnet.depot.live.drop_folder import DropFolder, split
from suspnet.depot.live.replay import FrameFiles, Replay
from suspnet.trains.recordings.frames import decode, encode


@pytest.fixture(scope="module")
def trip(tmp_path_factory):
    return write_trips(tmp_path_factory.mktemp("replayed") / "trips", minutes=1.1)[0]


@pytest.fixture(scope="module")
def expected(trip):
    return [encode(one) for one in Replay(trip.parent).frames()]


def run(trip, *arguments, cwd):
    return typed(replay, f"trips={trip.parent}", "progress=false", *arguments, cwd=cwd)


def test_folder_is_read_by_the_source(trip, expected, tmp_path):
    done = run(trip, "out=drop", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
    assert f"{len(expected)} frames with " in done.stderr
    assert " of 1 trip of 1 suspension in " in done.stderr
    files = sorted((tmp_path / "drop").iterdir())
    assert [file.name for file in files[:2]] == ["000000001.frames", "000000002.frames"]
    assert len(files) == 7
    source, found = DropFolder(tmp_path / "drop", once=True), []
    source.subscribe([])
    while (part := source.receive(1.0)) is not None:
        found += part
        source.confirm()
    assert found == expected
    with FrameFiles(tmp_path / "drop") as again:
        again.add(frame())
    assert (tmp_path / "drop" / "000000008.frames").read_bytes() == encode(frame())


def test_faulty_trip_is_told_and_the_exit_code_is_one(trip, tmp_path):
    (tmp_path / "trips").mkdir()
    changed(trip, tmp_path / "trips")
    (tmp_path / "trips" / "bad.yaml").write_text("suspension: simulated\n")
    done = typed(replay, f"trips={tmp_path / 'trips'}", "progress=false", "out=drop", cwd=tmp_path)
    assert done.returncode == 1
    assert "error: 1 trips are missing or incomplete, see above" in done.stderr
    data = b"".join(file.read_bytes() for file in sorted((tmp_path / "drop").iterdir()))
    assert {decode(one).suspension for one in split(data)[0]} == {"simulated"}


@pytest.mark.representatives(3)
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing mandatory value: out"),
        (["out=a", "times=0"], "`times` must be"),
        (["out=a", "sink=mqtt"], "sink"),
    ],
)
def test_mistake_gets_one_line(trip, tmp_path, arguments, message):
    done = run(trip, *arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
