"""The notifier: queues messages about alarms in the store, and sends what is due."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime

from suspnet.depot.live.channels import AddressError, DeliveryError
from suspnet.depot.live.notification_rules import Rules
from suspnet.trains.history import History, HistoryError
from suspnet.trains.history.outbox import MOST_ATTEMPTS, Message

log = logging.getLogger(__name__)
LOOK_S = 10.0  # time between two looks for changed suspensions and due messages, [s]
LONGEST_LOOK_S = 60.0
"""Longest time between two looks at the alarms, also if no suspension changed, [s]."""
WAIT_S = 5.0  # time until an unavailable store is tried again, [s]


def _now() -> datetime:
    return datetime.now(UTC)


class Notifier:
    """Sends messages about the alarms of a store; `clock` returns the time with its zone.

    Several may run at the same time, in any programs: a message is claimed before it is sent. Each
    channel sends in a thread of its own, so that none waits for a slow server of another.
    """

    def __init__(self, store: History, rules: Rules, clock: Callable[[], datetime] = _now) -> None:
        self._store, self._rules, self._clock = store, rules, clock
        self._outbox = store.outbox()
        self._revisions: object = None
        self._looked_s = 0.0
        self._end = threading.Event()
        self._thread: threading.Thread | None = None
        self._deliveries: dict[str, threading.Thread] = {}
        self._faults: list[Exception] = []  # what ended the threads of channels

    def once(self) -> tuple[int, int]:
        """Queue what is new and send what is due; return the numbers of sent and failed messages.

        HistoryError is raised if the store cannot be used.
        """
        outcomes: list[bool] = []
        for delivery in self._start_due(outcomes):
            delivery.join()
        self._raise_fault()
        return sum(outcomes), len(outcomes) - sum(outcomes)

    def run(self) -> None:
        """Look and send until `close` is called; an unavailable store is waited for."""
        while not self._end.is_set():
            try:
                self._raise_fault()
                self._start_due([])
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
        for thread in filter(None, (self._thread, *self._deliveries.values())):
            thread.join(max(end_s - time.monotonic(), 0.0))

    def look(self) -> None:
        """Queue messages about alarms that are new, if a suspension changed or a minute passed."""
        revisions, now_s = self._store.revisions(), time.monotonic()
        if revisions == self._revisions and now_s - self._looked_s < LONGEST_LOOK_S:
            return
        n_queued = self._outbox.look(self._rules.recipients, self._clock(), self._rules.zone)
        self._revisions, self._looked_s = revisions, now_s
        if n_queued:
            log.info("%d messages about alarms are queued", n_queued)

    def _start_due(self, outcomes: list[bool]) -> list[threading.Thread]:
        """Queue what is new; start the channels with due messages that are not sending now.

        Their threads append to `outcomes` whether each message was accepted.
        """
        self.look()
        busy = {name for name, thread in self._deliveries.items() if thread.is_alive()}
        # messages of channels that other rules name belong to the programs with these rules
        due = self._outbox.due_channels(self._clock()) & self._rules.channels.keys() - busy
        for name in due:
            self._deliveries[name] = threading.Thread(
                target=self._send_due, args=(name, outcomes), name=f"notifier-{name}", daemon=True
            )
            self._deliveries[name].start()
        return [self._deliveries[name] for name in due]

    def _raise_fault(self) -> None:
        if self._faults:
            raise self._faults.pop(0)

    def _send_due(self, channel: str, outcomes: list[bool]) -> None:
        try:
            while (message := self._outbox.claim(self._clock(), [channel])) is not None:
                error = self._send(message)
                outcomes.append(error is None)
                is_of_server = error is not None and not isinstance(error, AddressError)
                if is_of_server or self._end.is_set():  # the others wait for the next look
                    return
        except Exception as error:  # raised in the notifier's own thread
            self._faults.append(error)

    def _send(self, message: Message) -> Exception | None:
        """Send a message and store the outcome; return why it was not accepted, or None."""
        try:
            self._rules.channels[message.channel].send(message)
        except (DeliveryError, OSError, ValueError) as error:  # a secret may be gone by now
            is_last = message.attempts + 1 >= MOST_ATTEMPTS
            outcome = "given up" if is_last else "it is tried again"
            log.warning("a message to %s failed, %s: %s", message.recipient, outcome, error)
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
