"""Destinations of a replay's frames: a folder, a broker."""

from __future__ import annotations

import logging
import re
import threading
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from queue import Empty, Queue
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from suspnet.depot.live.broker import KEEPALIVE_S, Broker
from suspnet.depot.live.drop_folder import TAKEN
from suspnet.ground.settings import Setting, check_values
from suspnet.ground.storage import write_atomically
from suspnet.trains.recordings.dates import SECOND_NS
from suspnet.trains.recordings.frames import Frame, encode

if TYPE_CHECKING:
    from paho.mqtt.client import Client

log = logging.getLogger(__name__)
NUMBERED = re.compile(r"\d{9}", re.ASCII)  # names of the files that a `Folder` writes
MAX_FILE_BYTES = 2**23  # after which the next file is started
ANSWER_S = 10.0  # timeout of the first connection to a broker
IN_FLIGHT = 100  # frames that a broker may not yet have acknowledged


class Sink(Protocol):
    """Interface of a destination of frames; `counts` are problems by a reason of one word."""

    @property
    def counts(self) -> Counter[str]:
        """Counts of problems."""

    def open(self) -> None:
        """Prepare to send; OSError or ValueError if that is not possible."""

    def send(self, frame: Frame) -> None:
        """Send a frame; wait while the receiver does not take it."""

    def close(self) -> None:
        """Send waiting frames, and wait until all are taken."""


class Folder:
    """Writes frames into files as ``source=folder`` reads them: of all sensors, in their order.

    A file appears atomically. It holds at most ``MAX_FILE_BYTES`` and one frame.
    """

    settings: ClassVar[Mapping[str, Setting]] = {
        "folder": Setting("Folder of the files, created if it is missing", rule="path"),
        "file_s": Setting("Time that a file covers, of all sensors", "s", above=0, high=86400),
    }

    def __init__(self, folder: str | Path, file_s: float = 10.0) -> None:
        check_values(Folder, file_s=file_s)
        self.counts: Counter[str] = Counter()
        self.folder, self.file_s = Path(folder), file_s
        self._held: list[bytes] = []
        self._n_bytes = self._n_files = self._first_ns = 0

    def open(self) -> None:
        """Create the folder; file names continue after the existing ones."""
        self.folder.mkdir(parents=True, exist_ok=True)
        files = [*self.folder.glob("*.frames"), *(self.folder / TAKEN).glob("*.frames")]
        numbers = [int(file.stem) for file in files if NUMBERED.fullmatch(file.stem)]
        self._n_files = max(numbers, default=0)

    def send(self, frame: Frame) -> None:
        """Add a frame to the file; write the file first if it is full."""
        is_over = frame.time_ns - self._first_ns >= self.file_s * SECOND_NS
        if self._held and (is_over or self._n_bytes >= MAX_FILE_BYTES):
            self.close()
        if not self._held:
            self._first_ns = frame.time_ns
        self._held.append(encode(frame))
        self._n_bytes += len(self._held[-1])

    def close(self) -> None:
        """Write the waiting frames."""
        if not self._held:
            return
        self._n_files += 1
        write_atomically(self.folder / f"{self._n_files:09d}.frames", b"".join(self._held))
        self._held.clear()
        self._n_bytes = 0


class MqttSink:
    """Publishes frames to PREFIX/frames/SUSPENSION, with QoS 1.

    At most ``IN_FLIGHT`` frames, or as many as the broker takes at once, are on the way; then `send`
    waits, also while the broker is disconnected. `counts` are frames "rejected" by the broker, and lost connections ("disconnect").
    """

    def __init__(self, broker: Broker | None = None) -> None:
        self.broker = Broker() if broker is None else broker
        self.counts: Counter[str] = Counter()
        self._answers: Queue[tuple[str, int]] = Queue()
        self._client: Client | None = None

    def open(self) -> None:
        """Connect to the broker; OSError or ValueError if the connection is refused."""
        client = self.broker.client("")  # the broker assigns a unique client id
        client.on_connect, client.on_publish = self._on_connect, self._on_publish
        client.on_disconnect = self._on_disconnect
        client.max_inflight_messages_set(IN_FLIGHT)
        where = self.broker.where
        try:
            client.connect(str(self.broker.host), self.broker.port, KEEPALIVE_S)
        except OSError as error:
            raise ConnectionError(error.errno, f"no broker: {error.strerror}", where) from error
        client.loop_start()
        try:
            refusal, most = self._answers.get(timeout=ANSWER_S)
        except Empty:
            refusal, most = f"no answer within {ANSWER_S:g} s", 0
        if refusal:
            client.disconnect()
            client.loop_stop()
            raise ValueError(f"the broker at {where}: {refusal}")
        # a broker disconnects a client with more messages in flight than it takes
        self._in_flight = min(IN_FLIGHT, most)
        self._room = threading.Semaphore(self._in_flight)
        self._client = client

    def send(self, frame: Frame) -> None:
        """Publish a frame as soon as there is room for it."""
        assert self._client is not None
        self._room.acquire()
        self._client.publish(self.broker.topic("frames", frame.suspension), encode(frame), qos=1)

    def close(self) -> None:
        """Wait until the broker has taken all frames, and disconnect."""
        if self._client is None:
            return
        for _ in range(self._in_flight):
            self._room.acquire()
        client, self._client = self._client, None
        client.disconnect()
        client.loop_stop()

    def _on_connect(self, client: Client, _: Any, flags: Any, reason: Any, more: Any) -> None:
        refusal = str(reason) if reason.is_failure else ""
        self._answers.put((refusal, getattr(more, "ReceiveMaximum", IN_FLIGHT)))

    def _on_disconnect(self, client: Client, *_: Any) -> None:
        if self._client is not None:
            self.counts["disconnect"] += 1
            log.warning("the broker at %s is not reachable; waiting for it", self.broker.where)

    def _on_publish(self, client: Client, _: Any, number: int, reason: Any, more: Any) -> None:
        if reason.is_failure:
            if not self.counts["rejected"]:
                log.warning("the broker refuses a frame: %s; others are only counted", reason)
            self.counts["rejected"] += 1
        self._room.release()
