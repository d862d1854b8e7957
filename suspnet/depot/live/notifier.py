"""The notifier: queues messages about alarms in the store, and sends what is due.

Recipients and channels are rules in a YAML file.
"""

import logging
import threading
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields
from datetime import datetime, tzinfo
from datetime import time as time_of_day
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from suspnet.depot.live.channels import AddressError, DeliveryError, Email, Webhook
from suspnet.ground.core_yaml import read_yaml
from suspnet.ground.parameters import Severity
from suspnet.trains.history import History, HistoryError
from suspnet.trains.history.outbox import MOST_ATTEMPTS, Message, Recipient
from suspnet.trains.recordings.dates import now

log = logging.getLogger(__name__)
LOOK_S = 10.0  # time between two looks for changed suspensions and due messages, [s]
LONGEST_LOOK_S = 60.0
"""Longest time between two looks at the alarms, also if no suspension changed, [s]."""
WAIT_S = 5.0  # time until an unavailable store is tried again, [s]
KINDS: Mapping[str, type[Email] | type[Webhook]] = {"email": Email, "webhook": Webhook}
"""Class of each kind of channel."""
LEVELS = {str(severity): severity for severity in (Severity.NOTICE, Severity.ACT)}


@dataclass(frozen=True)
class Rules:
    """Recipients, the channels by name, and the zone of digest times (None: the computer's)."""

    recipients: tuple[Recipient, ...]
    channels: Mapping[str, Email | Webhook]
    zone: tzinfo | None = None


class Notifier:
    """Sends messages about the alarms of a store; `clock` returns the time with its zone.

    Several may run at the same time, in any programs: a message is claimed before it is sent. A
    server that does not accept a message is not asked again before the next look.
    """

    def __init__(self, store: History, rules: Rules, clock: Callable[[], datetime] = now) -> None:
        self._store, self._rules, self._clock = store, rules, clock
        self._outbox = store.outbox()
        self._revisions: object = None
        self._looked_s = 0.0
        self._end = threading.Event()
        self._thread = threading.Thread(target=self.run, name="notifier", daemon=True)

    def once(self) -> tuple[int, int]:
        """Queue what is new and send what is due; return the numbers of sent and failed messages.

        HistoryError is raised if the store cannot be used.
        """
        self.look()
        n_sent = n_failed = 0
        # messages of channels that other rules name belong to the programs with these rules
        channels = set(self._rules.channels)
        while not self._end.is_set():  # ends: each round sends a message or gives up a channel
            message = self._outbox.claim(self._clock(), channels)
            if message is None:
                break
            error = self._send(message)
            n_sent, n_failed = n_sent + (error is None), n_failed + (error is not None)
            if error is not None and not isinstance(error, AddressError):
                channels.remove(message.channel)  # its others wait for the next look
        return n_sent, n_failed

    def run(self) -> None:
        """Look and send until `close` is called; an unavailable store is waited for."""
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
        self._thread.start()

    def close(self) -> None:
        """End the thread, after the message that is being sent."""
        self._end.set()
        if self._thread.is_alive():
            self._thread.join(WAIT_S)

    def look(self) -> None:
        """Queue messages about alarms that are new, if a suspension changed or a minute passed."""
        revisions, now_s = self._store.revisions(), time.monotonic()
        if revisions == self._revisions and now_s - self._looked_s < LONGEST_LOOK_S:
            return
        n_queued = self._outbox.look(self._rules.recipients, self._clock(), self._rules.zone)
        self._revisions, self._looked_s = revisions, now_s
        if n_queued:
            log.info("%d messages about alarms are queued", n_queued)

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


def read_rules(path: Path) -> Rules:
    """Return the rules of a file; ValueError or OSError, with place and remedy, if one is wrong.

    Secrets are looked up now, so that a missing one is an error at the start.
    """
    try:
        rules = _mapping(read_yaml(path), "the file", ("channels", "recipients", "timezone"))
        channels = {
            str(name): _channel(content, f"channels.{name}")
            for name, content in _mapping(rules.get("channels"), "channels").items()
        }
        recipients = tuple(
            _recipient(str(name), content, channels)
            for name, content in _mapping(rules.get("recipients"), "recipients").items()
        )
        zone = None if rules.get("timezone") is None else _zone(rules["timezone"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    if not recipients:
        raise ValueError(f"{path}: `recipients` must name a recipient")
    return Rules(recipients, channels, zone)


def _channel(content: Any, where: str) -> Email | Webhook:
    values = dict(_mapping(content, where))
    kind = values.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"`{where}.kind` must be one of {', '.join(KINDS)}, got {kind!r}")
    _mapping(values, where, [field.name for field in fields(KINDS[kind])])
    try:
        return KINDS[kind](**values)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{where}`: {error}") from None


def _recipient(name: str, content: Any, channels: Mapping[str, Email | Webhook]) -> Recipient:
    where = f"recipients.{name}"
    values = _mapping(content, where, ("channels", "to", *OPTIONS))
    # only the keys of the file: the defaults of the others are those of `Recipient`
    options: dict[str, Any] = {
        key: read(values[key], f"{where}.{key}") for key, read in OPTIONS.items() if key in values
    }
    recipient = Recipient(name, _targets(values, where, channels), **options)
    if recipient.digest is None and not recipient.at_once:
        raise ValueError(f"`{where}` has neither `at_once` nor `digest`: nothing would be sent")
    return recipient


def _targets(
    values: Mapping[Any, Any], where: str, channels: Mapping[str, Email | Webhook]
) -> tuple[tuple[str, str], ...]:
    """Return pairs of channel and address, which is empty for others than mails."""
    addresses = _texts(values.get("to", []), f"{where}.to", least=0)
    targets: list[tuple[str, str]] = []
    for channel in _texts(values.get("channels"), f"{where}.channels"):
        if channel not in channels:
            names = ", ".join(channels) or "none"
            raise ValueError(f"`{where}.channels`: {channel!r} is not a channel; known: {names}")
        destinations = addresses if isinstance(channels[channel], Email) else ("",)
        try:
            channels[channel].check(destinations)
        except (OSError, ValueError) as error:
            raise ValueError(f"`{where}`, channel {channel!r}: {error}") from None
        targets += [(channel, address) for address in destinations]
    return tuple(dict.fromkeys(targets))


def _mapping(content: Any, where: str, keys: Collection[str] | None = None) -> Mapping[Any, Any]:
    if not isinstance(content, Mapping):
        raise ValueError(f"`{where}` must be a mapping, got {content!r}")
    for key in content:
        if keys is not None and key not in keys:
            raise ValueError(f"`{where}` has no key {key!r}; known: {', '.join(keys)}")
    return content


def _texts(content: Any, where: str, least: int = 1) -> tuple[str, ...]:
    if not isinstance(content, list) or not all(isinstance(text, str) for text in content):
        raise ValueError(f"`{where}` must be a list of texts, got {content!r}")
    if len(content) < least:
        raise ValueError(f"`{where}` is empty, so that nothing would be sent")
    return tuple(content)


def _levels(content: Any, where: str) -> frozenset[Severity]:
    names = _texts(content, where, least=0)
    if set(names) - set(LEVELS):
        raise ValueError(f"`{where}` must be of {', '.join(LEVELS)}, got {content!r}")
    return frozenset(LEVELS[name] for name in names)


def _time(content: Any, where: str) -> time_of_day | None:
    try:
        return None if content is None else time_of_day.fromisoformat(content).replace(tzinfo=None)
    except (TypeError, ValueError):
        raise ValueError(f"`{where}` must be a time such as 06:00, got {content!r}") from None


def _zone(content: Any) -> ZoneInfo:
    try:
        return ZoneInfo(content)
    except (KeyError, OSError, TypeError, ValueError):
        raise ValueError(f"`timezone` must be a name as Europe/Berlin, got {content!r}") from None


OPTIONS: Mapping[str, Callable[[Any, str], Any]] = {
    "at_once": _levels,
    "digest": _time,
    "severities": _levels,
    "vehicles": _texts,
    "suspensions": _texts,
}
"""Keys of a recipient that are fields of `Recipient`, and what reads each."""
