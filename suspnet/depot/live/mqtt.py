"""Frames from an MQTT 5 broker."""

from __future__ import annotations

import hashlib
import importlib
import logging
import re
import threading
import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from suspnet.depot.live.broker import KEEPALIVE_S, Broker
from suspnet.ground.extras import import_extra
from suspnet.ground.settings import check_settings, setting
from suspnet.trains.recordings.frames import MOST_BYTES

if TYPE_CHECKING:
    from paho.mqtt.client import Client

log = logging.getLogger(__name__)
MAX_TOPICS = 100  # of one request of a subscription
TAKEN_OVER = "Session taken over"
"""Reason, as paho-mqtt names it, for which a broker ends a connection when another client of the
same name connects. Mosquitto 2.0.11 states none."""
CLOSING_S = 5.0  # longest time that `close` waits until acknowledgements are sent


@dataclass(eq=False)
class Mqtt:
    """Source of the frames on the topics PREFIX/frames/SUSPENSION, percent-encoded.

    Each frame arrives at least once: the client acknowledges frames when they are confirmed, and
    the broker stores the others while the client is disconnected (QoS 1, no clean start, session
    expiry). The client reconnects with backoff, also if the broker was never reachable.

    At most `in_flight` frames wait for `receive`: the broker is asked to send no more before some
    are acknowledged, and as not every broker obeys, the connection is not read beyond that. A
    message larger than any frame is acknowledged and dropped at once; withheld by the broker, it
    would occupy a place among the messages in flight for ever (Mosquitto 2.0.11). `counts` are
    "disconnect", "reconnect", "unreachable", "rejected", and the "size" of a message.
    """

    broker: Broker = field(default_factory=Broker)
    client_id: str = setting(
        "suspnet-monitor",
        "Name by which the broker knows the monitor and stores frames for it",
        rule="text",
    )
    part: str = setting(
        "1/1",
        'Which of several monitors that share a broker this is: "2/4" takes the suspensions of '
        "the second of four parts",
        rule="text; K/N with K at most N",
    )
    in_flight: int = setting(
        2000,
        "Number of frames that may be on the way to the monitor, in its memory",
        low=1,
        high=65535,
    )
    session_h: float = setting(
        24.0,
        "Time for which the broker stores frames for a disconnected monitor",
        "h",
        above=0,
        high=10000,
    )

    def __post_init__(self) -> None:
        check_settings(self)
        self.shard, self.n_shards = read_shard(self.part)
        self.client_name = f"{self.client_id}-{self.shard}-of-{self.n_shards}"
        self.is_connected = False
        self.counts: Counter[str] = Counter()
        self._client: Client | None = None
        self._topics: list[str] = []
        # shared with the client thread: messages by number of the connection, under `_changed`
        self._changed = threading.Condition()
        self._arrived: deque[tuple[int, int, bytes]] = deque()
        self._connection = 0
        self._is_away = self._is_closing = self._is_replaced = False
        # of the calling thread only
        self._delivered: list[tuple[int, int]] = []

    def subscribe(self, suspensions: Sequence[str]) -> Sequence[str]:
        """Start to connect; return the suspensions of this process. See `FrameSource`."""
        subscribed = [name for name in suspensions if is_in_shard(name, self.shard, self.n_shards)]
        self._topics = [self.broker.topic(name) for name in subscribed]
        client = self.broker.client(self.client_name, manual_ack=True)
        client.on_connect, client.on_disconnect = self._on_connect, self._on_disconnect
        client.on_connect_fail, client.on_message = self._on_connect_fail, self._on_message
        client.on_subscribe = self._on_subscribe
        packet = import_extra("paho.mqtt.packettypes", "live", "MQTT").PacketTypes.CONNECT
        properties = import_extra("paho.mqtt.properties", "live", "MQTT").Properties(packet)
        properties.SessionExpiryInterval = round(3600 * self.session_h)
        properties.ReceiveMaximum = self.in_flight
        where = str(self.broker.host), self.broker.port, KEEPALIVE_S
        client.connect_async(*where, clean_start=False, properties=properties)
        client.loop_start()
        self._client = client
        return subscribed

    def receive(self, timeout_s: float) -> list[bytes]:
        """Return the frames received so far; the source never ends. See `FrameSource`.

        ValueError is raised once another monitor has taken over the session: of two that share
        frames, each would see a part of every section.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._arrived or self._is_replaced, timeout_s)
            if self._is_replaced:
                raise ValueError(
                    f"the broker at {self.broker.where}: another monitor has connected as "
                    f"{self.client_name!r}; give each a `part` (source.part=1/2, source.part=2/2) "
                    "or a `client_id` of its own"
                )
            arrived = list(self._arrived)
            self._arrived.clear()
            self._changed.notify_all()
        self._delivered += [(connection, number) for connection, number, _ in arrived]
        return [message for _, _, message in arrived]

    def confirm(self, n_frames: int | None = None) -> None:
        """Acknowledge frames that `receive` returned. See `FrameSource`."""
        assert self._client is not None
        n_confirmed = len(self._delivered) if n_frames is None else n_frames
        with self._changed:  # the connection must not change meanwhile
            for connection, number in self._delivered[:n_confirmed]:
                # messages of an earlier connection are resent, under the same number or another;
                # number 0 is a message without acknowledgement (QoS 0)
                if number and self.is_connected and connection == self._connection:
                    self._client.ack(number, 1)
        del self._delivered[:n_confirmed]

    def close(self) -> None:
        """Send acknowledgements if the broker takes them, and disconnect; the session remains."""
        if self._client is None:
            return
        deadline = time.monotonic() + CLOSING_S
        while time.monotonic() < deadline and self.is_connected and self._client.want_write():
            time.sleep(0.01)
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        self._client.disconnect()
        self._client.loop_stop()
        self._client = None

    def _on_connect(self, client: Client, _: Any, flags: Any, reason: Any, more: Any) -> None:
        """Subscribe; the broker resends frames not acknowledged over the last connection."""
        if reason.is_failure:
            self._count("rejected", str(reason))
            return
        with self._changed:
            if self._connection:
                self.counts["reconnect"] += 1
            self._connection += 1
            self.is_connected, self._is_away = True, False
        log.info("connected to the broker at %s", self.broker.where)
        options = importlib.import_module("paho.mqtt.subscribeoptions").SubscribeOptions
        only_new = options(qos=1, retainHandling=options.RETAIN_DO_NOT_SEND)
        for start in range(0, len(self._topics), MAX_TOPICS):
            topics = self._topics[start : start + MAX_TOPICS]
            client.subscribe([(topic, only_new) for topic in topics])

    def _on_disconnect(self, client: Client, _: Any, flags: Any, reason: Any, more: Any) -> None:
        with self._changed:
            self.is_connected = False
            self._is_replaced |= reason == TAKEN_OVER  # a last disconnection has another reason
            self._changed.notify_all()
        if self._is_replaced:
            client.disconnect()  # it would connect again, and replace the other one
        elif not self._is_closing:
            self._count("disconnect", "the connection is lost")

    def _on_connect_fail(self, client: Client, userdata: Any) -> None:
        self._count("unreachable", "connection refused")

    def _on_subscribe(self, client: Client, _: Any, number: int, reasons: Any, more: Any) -> None:
        for reason in reasons:
            if reason.is_failure:
                self._count("rejected", f"a subscription: {reason}")

    def _on_message(self, client: Client, userdata: Any, message: Any) -> None:
        if len(message.payload) > MOST_BYTES:
            self.counts["size"] += 1
            client.ack(message.mid, message.qos)
            return
        with self._changed:
            self._changed.wait_for(lambda: len(self._arrived) < self.in_flight or self._is_closing)
            self._arrived.append((self._connection, message.mid, message.payload))
            self._changed.notify_all()

    def _count(self, reason: str, message: str) -> None:
        """Count a problem with the broker, and log the first one of each connection."""
        self.counts[reason] += 1
        if not self._is_away:
            where = self.broker.where
            log.warning("the broker at %s: %s; retrying until it answers", where, message)
        self._is_away = True


def read_shard(text: str) -> tuple[int, int]:
    """Return K and N of the text "K/N"; ValueError unless 1 <= K <= N <= 1000."""
    match = re.fullmatch(r"(\d{1,4})/(\d{1,4})", text) if isinstance(text, str) else None
    shard, n_shards = map(int, match.groups()) if match else (0, 0)
    if not 1 <= shard <= n_shards <= 1000:
        raise ValueError(f'`part` must be "K/N" with 1 <= K <= N <= 1000, got {text!r}')
    return shard, n_shards


def is_in_shard(suspension: str, shard: int, n_shards: int) -> bool:
    """Return whether a suspension belongs to a shard, by SHA-256 of its name.

    >>> [k for k in (1, 2, 3) if is_in_shard("train 1, car 2", k, 3)]
    [1]
    """
    digest = hashlib.sha256(suspension.encode()).digest()
    return int.from_bytes(digest[:8], "big") % n_shards == shard - 1
