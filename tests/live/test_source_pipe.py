"""Frames on standard input: read by a thread, bounded, to the end."""

import json
import os
import subprocess
import sys
import threading
import time

import pytest
from live_frames import encoded, frame, until

from suspnet.live.source import Inbox, Pipe
from suspnet.recordings.frames import encode

FRAMES = encoded(50)


@pytest.fixture
def connected(monkeypatch):
    """Return a source, and the file that its standard input is the other end of."""
    made = []

    def connect(**options):
        ends = os.pipe()
        reader, writer = os.fdopen(ends[0], "rb"), os.fdopen(ends[1], "wb", buffering=0)
        monkeypatch.setattr(sys, "stdin", reader)
        source = Pipe(**options)
        made.append((source, reader, writer))
        return source, writer

    yield connect
    for source, reader, writer in made:
        source.close()
        reader.close()
        writer.close()


def test_frames_come_in_their_order_and_then_the_end(connected):
    source, writer = connected()
    assert source.subscribe(["a", "b"]) == ["a", "b"]
    writer.write(b"noise" + b"".join(FRAMES))
    found = []
    while len(found) < len(FRAMES):  # ends: a test has a time limit
        found += source.receive(1.0)
        source.confirm()
    assert found == FRAMES
    assert source.receive(0.0) == []
    writer.write(FRAMES[0][:100])
    writer.close()
    assert until(lambda: source.receive(0.1) is None)
    assert source.receive(0.0) is None
    assert source.counts == {"foreign": 1, "truncated": 1}


def test_receive_waits_no_longer_than_it_was_told(connected):
    source, _ = connected()
    source.subscribe([])
    begin = time.monotonic()
    assert source.receive(0.2) == []
    assert 0.15 < time.monotonic() - begin < 2


def test_receive_returns_as_soon_as_there_is_a_frame(connected):
    source, writer = connected()
    source.subscribe([])
    threading.Timer(0.1, writer.write, [FRAMES[0]]).start()
    begin = time.monotonic()
    assert source.receive(30.0) == [FRAMES[0]]
    assert time.monotonic() - begin < 5


def test_close_ends_the_reading_while_nothing_comes(connected):
    source, _ = connected()
    before = set(threading.enumerate())
    source.subscribe([])
    source.close()
    assert set(threading.enumerate()) <= before  # those of other tests may have ended
    assert source.receive(0.0) is None


def test_sender_waits_while_the_buffer_is_full(connected):
    source, writer = connected(buffer_mb=1.0)
    source.subscribe([])
    large = encode(frame(n=50_000))
    sent = []

    def send():
        for _ in range(20):
            writer.write(large)
            sent.append(len(large))

    thread = threading.Thread(target=send)
    thread.start()
    until(lambda: sum(sent) > 3e6, 0.5)
    assert sum(sent) < 1e6 + 3 * len(large)  # what waits, one in the reader, a part in the pipe
    found = []
    while len(found) < 20:  # ends: a test has a time limit
        part = source.receive(1.0)
        assert sum(map(len, part)) <= 1e6
        found += part
    thread.join()
    assert found == [large] * 20


def test_inbox_has_room_for_one_frame_of_any_size():
    inbox = Inbox(10)
    inbox.put(b"x" * 100)
    assert inbox.take(0.0) == [b"x" * 100]
    inbox.put(b"y")
    inbox.end()
    inbox.put(b"z")
    assert inbox.take(0.0) == [b"y"]
    assert inbox.take(0.0) is None


def test_results_are_lines_of_json(connected, capsys):
    source, _ = connected()
    source.publish("estimates", "train 1", b'{"k_p": 0.9,\n "flags": ""}')
    source.publish("alarms", 'a "b"', b"{}")
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == {"kind": "estimates", "suspension": "train 1", "k_p": 0.9, "flags": ""}
    assert lines[1] == {"kind": "alarms", "suspension": 'a "b"'}


def test_frames_of_another_process_are_read():
    script = (
        "from suspnet.live.source import Pipe\n"
        "source, n = Pipe(), 0\n"
        "source.subscribe([])\n"
        "while (part := source.receive(1.0)) is not None:\n"
        "    n += len(part)\n"
        "print(n, dict(source.counts))\n"
        "source.close()\n"
    )
    data = b"\n".join(FRAMES)
    done = subprocess.run(
        [sys.executable, "-c", script], input=data, capture_output=True, check=True
    )
    assert done.stdout.decode() == "50 {'foreign': 49}\n"
