"""Frames, and a real broker, for the tests of live sources."""

import os
import queue
import shutil
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from suspnet.trains.recordings.frames import Frame, decode, encode

CONFIGURATION = Path(__file__).parents[1] / "examples" / "mosquitto.conf"
ANSWERS_S = 8.0


def frame(k=0, suspension="train 1, car 2", sensor="body", n=20, **changes):
    """Return the kth frame of a sensor; its samples tell which one it is."""
    samples = np.arange(k, k + n, dtype=np.float32)
    options = {
        "samples": samples,
        "sequence": k,
        "time_ns": 10**18 + k * 10**9,
        "rate_hz": float(n),
        "unit": "m/s2",
    }
    return Frame(suspension, sensor, **(options | changes))


def encoded(n, **options):
    """Return n encoded frames that follow each other."""
    return [encode(frame(k, **options)) for k in range(n)]


def numbers(frames):
    """Return suspension, sensor and number of each encoded frame."""
    decoded = map(decode, frames)
    return [(one.suspension, one.sensor, one.sequence) for one in decoded]


def until(condition, seconds=ANSWERS_S):
    """Return the first true value of a condition, or its last one after a time."""
    last = time.monotonic() + seconds
    while not (found := condition()) and time.monotonic() < last:
        time.sleep(0.02)
    return found


def received(source, n, seconds=ANSWERS_S):
    """Return the frames that a source gives until there are n, without confirming them."""
    last, found = time.monotonic() + seconds, []
    while len(found) < n and time.monotonic() < last:
        found += source.receive(0.1) or []
    return found


class Sender:
    """An MQTT client that publishes frames; at most `in_flight` are not acknowledged."""

    def __init__(self, broker, in_flight=20):
        self.broker, self.in_flight = broker, in_flight
        self.room, answers = threading.Semaphore(in_flight), queue.Queue()
        self.client = broker.client("")
        self.client.on_connect = lambda _, __, ___, reason, ____: answers.put(reason)
        self.client.on_publish = lambda *_: self.room.release()
        self.client.connect(broker.host, broker.port, 30)
        self.client.loop_start()
        reason = answers.get(timeout=ANSWERS_S)
        if reason.is_failure:
            self.client.loop_stop()
            raise ValueError(str(reason))

    def send(self, frame):
        self.give(frame.suspension, encode(frame))

    def give(self, suspension, data):
        self.room.acquire()
        self.client.publish(self.broker.topic(suspension), data, qos=1)

    def close(self):
        """Wait until the broker has taken all frames, and disconnect."""
        for _ in range(self.in_flight):
            self.room.acquire()
        self.in_flight = 0
        self.client.disconnect()
        self.client.loop_stop()


class Mosquitto:
    """A broker with the example configuration in a folder, on a port of its own."""

    def __init__(self, folder, *lines, port=None):
        program = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin")
        if program is None:
            pytest.skip("needs the program mosquitto")
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = port or free.getsockname()[1]
        text = CONFIGURATION.read_text(encoding="utf-8")
        assert "\nlistener 1883 127.0.0.1\n" in text
        text = text.replace("\nlistener 1883 ", f"\nlistener {self.port} ")
        if os.geteuid() == 0:  # mosquitto would become a user who cannot write here
            lines = ("user root", *lines)
        file = folder / "mosquitto.conf"
        file.write_text("\n".join([text, *lines, ""]), encoding="utf-8")
        self.command, self.folder = [program, "-c", str(file)], folder
        self.log = folder / "mosquitto.log"
        self.process = None

    def start(self):
        with self.log.open("a") as log:
            self.process = subprocess.Popen(self.command, cwd=self.folder, stderr=log)
        assert until(self.answers), self.log.read_text()
        return self

    def answers(self):
        with socket.socket() as client:
            return client.connect_ex(("127.0.0.1", self.port)) == 0

    def save(self):
        """Have the broker write its state, as it does every few seconds."""
        database = self.folder / "mosquitto.db"
        before = database.stat().st_mtime_ns if database.exists() else 0
        self.process.send_signal(signal.SIGUSR1)
        assert until(lambda: database.exists() and database.stat().st_mtime_ns > before)

    def end(self, number=signal.SIGTERM):
        if self.process is not None:
            self.process.send_signal(number)
            self.process.wait(ANSWERS_S)
            self.process = None
