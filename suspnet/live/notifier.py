"""The notifier: queues messages about alarms in the store, and sends what is due."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
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

    Several may run at the same time, in any programs: a message is claimed before it is sent.
    """

    def __init__(self, store: History, rules: Rules, clock: Callable[[], datetime] = _now) -> None:
        self._store, self._rules, self._clock = store, rules, clock
        self._outbox: Outbox = store.outbox()
        self._revisions: object = None
        self._looked_s = 0.0
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    def once(self) -> tuple[int, int]:
        """Queue what is new and send what is due; return the numbers of sent and failed messages.

        HistoryError is raised if the store cannot be used.
        """
        self._look()
        # those of channels that other rules name belong to the programs with these rules
        usable = set(self._rules.channels)
        n_sent = n_failed = 0
        while (message := self._outbox.claim(self._clock(), usable)) is not None:
            error = self._send(message)
            n_sent += error is None
            n_failed += error is not None
            if error is not None and not isinstance(error, AddressError):
                # the other messages of the channel wait for the next look
                usable.discard(message.channel)
            if self._end.is_set():
                break
        return n_sent, n_failed

    def run(self) -> None:
        """Look and send until `stop` is called; an unavailable store is waited for."""
        while not self._end.is_set():
            try:
                self.once()
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
        """End the thread, after the message that is being sent."""
        self._end.set()
        if self._thread is not None:
            self._thread.join(WAIT_S)

    def _look(self) -> None:
        revisions, now_s = self._store.revisions(), time.monotonic()
        if revisions == self._revisions and now_s - self._looked_s < AT_LEAST_S:
            return
        n = self._outbox.look(self._rules.recipients, self._clock(), self._rules.zone)
        self._revisions, self._looked_s = revisions, now_s
        if n:
            log.info("%d messages about alarms are queued", n)

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
