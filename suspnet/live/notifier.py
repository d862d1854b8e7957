"""The notifier: queues messages about alarms in the store, and sends what is due."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from datetime import UTC, datetime

from suspnet.history import History, HistoryError
from suspnet.history.outbox import MOST_ATTEMPTS, Message, Outbox
from suspnet.live.channels import AddressError, DeliveryError
from suspnet.live.notification_rules import Rules

log = logging.getLogger(__name__)
LOOK_S = 10.0
"""Time between two looks for changed suspensions and due messages, [s]."""
AT_LEAST_S = 60.0
"""Longest time between two looks at the alarms, also if no suspension changed, [s]."""
WAIT_S = 5.0
"""Time until an unavailable store is tried again, [s]."""


def _now() -> datetime:
    return datetime.now(UTC)


class Notifier:
    """Sends messages about the alarms of a store; `clock` returns the time with its zone.

    Several may run at the same time, in any programs: a message is claimed before it is sent. Each
    channel sends in a thread of its own, so that none waits for a slow server of another.
    """

    def __init__(self, store: History, rules: Rules, clock: Callable[[], datetime] = _now) -> None:
        self._store, self._rules, self._clock = store, rules, clock
        self._outbox: Outbox = store.outbox()
        self._revisions: object = None
        self._looked_s = 0.0
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._deliveries: dict[str, _Delivery] = {}

    def once(self) -> tuple[int, int]:
        """Queue what is new and send what is due; return the numbers of sent and failed messages.

        HistoryError is raised if the store cannot be used.
        """
        started = self._start()
        for one in started:
            one.join()
        self._raise_faults()
        return sum(one.n_sent for one in started), sum(one.n_failed for one in started)

    def run(self) -> None:
        """Look and send until `stop` is called; an unavailable store is waited for."""
        while not self._end.is_set():
            try:
                self._raise_faults()
                self._start()
            except HistoryError as error:
                log.warning("%s; notifications wait for it, none is lost", error)
            except Exception:  # monitoring must go on
                log.exception("notifications failed; trying again")
            self._end.wait(LOOK_S)

    def start(self) -> None:
        """Run in a thread of its own."""
        self._thread = threading.Thread(target=self.run, name="notifier", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the threads, after the messages that are being sent."""
        self._end.set()
        end_s = time.monotonic() + WAIT_S
        for one in filter(None, (self._thread, *self._deliveries.values())):
            one.join(max(end_s - time.monotonic(), 0.0))

    def _look(self) -> None:
        revisions, now_s = self._store.revisions(), time.monotonic()
        if revisions == self._revisions and now_s - self._looked_s < AT_LEAST_S:
            return
        n = self._outbox.look(self._rules.recipients, self._clock(), self._rules.zone)
        self._revisions, self._looked_s = revisions, now_s
        if n:
            log.info("%d messages about alarms are queued", n)

    def _start(self) -> list[_Delivery]:
        """Queue what is new; start the channels that have something to send and are not at it."""
        self._look()
        busy = {name for name, one in self._deliveries.items() if one.is_alive()}
        # messages of channels that other rules name belong to the programs with these rules
        due = self._outbox.due_channels(self._clock()) & self._rules.channels.keys() - busy
        self._deliveries |= {name: _Delivery(self._send_due, name) for name in due}
        started = [self._deliveries[name] for name in due]
        for one in started:
            one.start()
        return started

    def _raise_faults(self) -> None:
        """Raise what ended the thread of a channel, once."""
        for one in self._deliveries.values():
            if one.fault is not None:
                fault, one.fault = one.fault, None
                raise fault

    def _send_due(self, channel: str) -> Iterator[bool]:
        """Send the messages of a channel that are due; yield whether each was accepted."""
        while (message := self._outbox.claim(self._clock(), [channel])) is not None:
            error = self._send(message)
            yield error is None
            is_of_server = error is not None and not isinstance(error, AddressError)
            if is_of_server or self._end.is_set():  # the other messages wait for the next look
                return

    def _send(self, message: Message) -> Exception | None:
        """Send a message and store the outcome; return why it was not accepted, or None."""
        try:
            self._rules.channels[message.channel].send(message)
        except (DeliveryError, OSError, ValueError) as error:  # a secret may be gone by now
            n = message.attempts + 1
            how = "given up" if n >= MOST_ATTEMPTS else "it is tried again"
            log.warning("a message to %s failed, %s: %s", message.recipient, how, error)
            self._outbox.mark_failed(message, str(error), self._clock())
            return error
        while True:  # ends: when the store is available, or the notifier is to end
            try:
                self._outbox.mark_sent(message, self._clock())
                break
            except HistoryError as error:
                log.warning("%s; a sent message waits to be marked", error)
                if self._end.wait(WAIT_S):
                    raise
        log.info("sent to %s by %s: %s", message.recipient, message.channel, message.id)
        return None


class _Delivery(threading.Thread):
    """Thread that sends the messages of one channel, and what came of it."""

    def __init__(self, send: Callable[[str], Iterable[bool]], channel: str) -> None:
        super().__init__(name=f"notifier-{channel}", daemon=True)
        self._send, self._channel = send, channel
        self.n_sent = self.n_failed = 0
        self.fault: Exception | None = None

    def run(self) -> None:
        try:
            for is_accepted in self._send(self._channel):
                self.n_sent += is_accepted
                self.n_failed += not is_accepted
        except Exception as error:  # raised by the notifier
            self.fault = error
