"""Frames on standard input: read as they are asked for, to the end."""

import json
import os
import sys
import threading
import time

import pytest
from live_frames import encoded, frame, until

from suspnet.depot.live.source import Pipe
from suspnet.trains.recordings.frames import encode

FRAMES = encoded(50)


@pytest.fixture
def connected(monkeypatch):
    """Give an opened source, and the file that its standard input is the other end of."""
    reader, writer = os.pipe()
    with os.fdopen(reader, "rb") as stdin, os.fdopen(writer, "wb", buffering=0) as sender:
        monkeypatch.setattr(sys, "stdin", stdin)
        source = Pipe()
        assert source.subscribe(["a", "b"]) == ["a", "b"]
        yield source, sender


def test_frames_come_in_their_order_and_then_the_end(connected):
    source, sender = connected
    sender.write(b"noise" + b"".join(FRAMES))
    frames = []
    while len(frames) < len(FRAMES):  # ends: a test has a time limit
        frames += source.receive(1.0)
        source.confirm()
    assert frames == FRAMES
    assert source.receive(0.0) == []
    sender.write(FRAMES[0][:100])
    sender.close()
    assert until(lambda: source.receive(0.1) is None)
    assert source.receive(0.0) is None
    assert source.counts == {"foreign": 1, "truncated": 1}


def test_receive_waits_for_a_frame_as_long_as_asked_and_a_closed_source_has_ended(connected):
    source, sender = connected
    begin = time.monotonic()
    assert source.receive(0.1) == []
    assert 0.05 < time.monotonic() - begin < 2
    threading.Timer(0.1, sender.write, [FRAMES[0]]).start()
    assert source.receive(30.0) == [FRAMES[0]]
    assert time.monotonic() - begin < 10
    source.close()
    assert source.receive(0.0) is None


def test_sender_waits_while_nothing_is_received(connected):
    source, sender = connected
    large, sent = encode(frame(n=50_000)), []
    thread = threading.Thread(target=lambda: [sent.append(sender.write(large)) for _ in range(5)])
    thread.start()
    until(lambda: sent, 0.3)
    assert not sent  # a pipe holds less than one of these frames
    frames = []
    while len(frames) < 5:  # ends: a test has a time limit
        frames += source.receive(1.0)
    thread.join()
    assert frames == [large] * 5


def test_results_are_lines_of_json(connected, capsys):
    source, _ = connected
    source.publish("estimates", "train 1", b'{"k_p": 0.9,\n "flags": ""}')
    source.publish("alarms", 'a "b"', b"{}")
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == {"kind": "estimates", "suspension": "train 1", "k_p": 0.9, "flags": ""}
    assert lines[1] == {"kind": "alarms", "suspension": 'a "b"'}
    for payload in (b"", b"{", b"[1]", b"\xff"):
        with pytest.raises(ValueError, match=r"."):
            source.publish("alarms", "a", payload)
