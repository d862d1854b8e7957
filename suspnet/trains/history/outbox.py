"""Messages about alarms, queued in the store before they are sent: an outbox.

What is new to a recipient follows from the stored alarms and from the table `told`, which holds
what was reported to each. So no program that raises alarms has to be running when they are sent,
and none can lose one. `look` queues messages and notes their alarms in one transaction. A message
is claimed for ``LEASE_S`` while it is sent and marked once the server has accepted it: it is sent
at least once. It is sent again only if the program ends between acceptance and mark, or the answer
is lost; it then has the same id.
"""

import json
from collections.abc import Callable, Collection, Iterable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, time, tzinfo
from fnmatch import fnmatchcase
from typing import Any

import sqlalchemy as sql
from sqlalchemy.engine import Connection

from suspnet.ground.findings import Finding, as_plain, parts_of, restored, together
from suspnet.ground.parameters import Severity
from suspnet.ground.records import OK, Key
from suspnet.ground.storage import content_hash, json_bytes
from suspnet.trains.history.database import upsert
from suspnet.trains.history.schema import (
    BadRow,
    Condition,
    is_one_of,
    known_suspensions,
    or_null,
    outbox,
    read_stored,
    suspensions,
    told,
    trips,
)
from suspnet.trains.maintenance.alarms import Acknowledgement, Alarm, newest_of

LEASE_S = 300.0
"""Time for which a message that is being sent belongs to one program, [s]; longer than sending it
may take. After a kill it is sent again after this time."""
FIRST_WAIT_S, LONGEST_WAIT_S = 60.0, 6 * 3600.0
"""Time until a failed message is tried again, [s]: it doubles with each failure up to a limit."""
MOST_ATTEMPTS = 20
"""Number of failures, in about three days, after which a message is not tried again."""
KEPT_S = 90 * 86400.0  # time for which a sent message stays in the store, [s]
MOST_LISTED = 100  # largest number of unsent messages that are listed
LOCK = 0x73757371  # number of PostgreSQL's advisory lock under which messages are queued
START = "start"  # kind of the row that says since when a recipient is known; it is not sent


@dataclass(frozen=True)
class Recipient:
    """A recipient, and which alarms are reported to it.

    `targets` are pairs of channel and address. Open alarms of a severity `at_once` are sent at the
    next look; the digest of a day, from the local time `digest` on (None: no digest), lists those
    of `severities`. `vehicles` and `suspensions` are patterns, as of file names, of which one must
    match the vehicle's name and the suspension's place.
    """

    name: str
    targets: tuple[tuple[str, str], ...]
    at_once: frozenset[Severity] = frozenset({Severity.ACT})
    severities: frozenset[Severity] = frozenset({Severity.NOTICE, Severity.ACT})
    digest: time | None = time(6)
    vehicles: tuple[str, ...] = ("*",)
    suspensions: tuple[str, ...] = ("*",)

    def is_about(self, key: Key) -> bool:
        """Return whether a suspension is one of this recipient's."""
        texts = (key[0], self.vehicles), (str(key[1]), self.suspensions)
        return all(any(fnmatchcase(text, p) for p in patterns) for text, patterns in texts)


@dataclass(frozen=True)
class Message:
    """A claimed message; `content` is JSON-able."""

    id: str
    recipient: str
    channel: str
    address: str
    kind: str
    content: dict[str, Any]
    attempts: int


@dataclass(frozen=True)
class _Reported:
    severity: int
    at_km: float
    is_open: bool

    def state(self, alarm: Alarm, is_last: bool) -> str:
        """Return what an alarm is to the recipient: new, worse, known, cleared or old.

        `is_last`: no later one starts up to `at_km`, so that this is the one that was reported.
        """
        if alarm.begin_km > self.at_km:
            return "new"
        # a late trip may have cleared the reported alarm before the mileage `at_km`
        if alarm.end_km < self.at_km and not (is_last and self.is_open):
            return "old"
        if alarm.severity > self.severity:
            return "worse"
        return "cleared" if self.is_open and not alarm.is_open else "known"


class Outbox:
    """Messages of a store; `reading` and `writing` start a transaction of it.

    Unreadable rows are appended to `bad`, which the store logs.
    """

    def __init__(
        self,
        reading: Callable[[], AbstractContextManager[Connection]],
        writing: Callable[[], AbstractContextManager[Connection]],
        bad: list[BadRow],
    ) -> None:
        self._reading, self._writing, self._bad = reading, writing, bad

    def look(self, recipients: Iterable[Recipient], now: datetime, zone: tzinfo | None) -> int:
        """Queue messages about what is new to each recipient, and return their number.

        `now` has a zone; digests are due by the clock of `zone` (None: this computer's). Alarms
        that were cleared before a recipient was first named are never sent to it.
        """
        with self._reading() as connection:  # which blocks no writer
            fleet = _Fleet(connection, self._bad)
        with self._writing() as connection:
            if connection.dialect.name == "postgresql":
                connection.execute(sql.select(sql.func.pg_advisory_xact_lock(LOCK)))
            if _revisions(connection) != fleet.revisions:  # something changed in between
                fleet = _Fleet(connection, self._bad)
            old = outbox.c.sent_s < now.timestamp() - KEPT_S
            connection.execute(outbox.delete().where(old, outbox.c.kind != START))
            return sum(_queue(connection, r, fleet, now, zone) for r in recipients)

    def claim(self, now: datetime, channels: Collection[str]) -> Message | None:
        """Return the message of some channels that is due longest; None if none is.

        It is claimed for ``LEASE_S``.
        """
        now_s = now.timestamp()
        chosen = (
            sql.select(outbox)
            .where(_due(now_s), outbox.c.channel.in_(list(channels)))
            .order_by(outbox.c.due_s, outbox.c.created_s, outbox.c.id)
            .limit(1)
            .with_for_update(skip_locked=True)
        )
        with self._writing() as connection:
            row = connection.execute(chosen).mappings().first()
            if row is None:
                return None
            _update(connection, row["id"], leased_s=now_s + LEASE_S)
        names = ("id", "recipient", "channel", "address", "kind", "attempts")
        return Message(content=json.loads(row["content"]), **{name: row[name] for name in names})

    def mark_sent(self, message: Message, now: datetime) -> None:
        """Store that a server has accepted a message."""
        with self._writing() as connection:
            _update(connection, message.id, sent_s=now.timestamp(), error="")

    def mark_failed(self, message: Message, error: str, now: datetime) -> None:
        """Store why a message was not accepted, and when it is tried again."""
        wait_s = min(FIRST_WAIT_S * 2**message.attempts, LONGEST_WAIT_S)
        values = {"due_s": now.timestamp() + wait_s, "leased_s": 0.0, "error": error}
        with self._writing() as connection:
            _update(connection, message.id, attempts=message.attempts + 1, **values)

    def unsent(self) -> list[dict[str, Any]]:
        """Return the messages that no server has accepted yet, the oldest ``MOST_LISTED`` first.

        They are rows without the content.
        """
        columns = [column for column in outbox.columns if column.name != "content"]
        chosen = sql.select(*columns).where(outbox.c.sent_s.is_(None))
        with self._reading() as connection:
            rows = connection.execute(chosen.order_by(outbox.c.created_s).limit(MOST_LISTED))
            return [dict(row) for row in rows.mappings()]

    def count_unsent(self) -> tuple[int, int, float | None]:
        """Return how many messages wait and were given up, and when the oldest was created, [s]."""
        n_waiting = sql.func.count().filter(_waiting())
        chosen = sql.select(n_waiting, sql.func.count(), sql.func.min(outbox.c.created_s))
        with self._reading() as connection:
            row = connection.execute(chosen.where(outbox.c.sent_s.is_(None))).one()
        return row[0], row[1] - row[0], row[2]

    def retry(self) -> int:
        """Make all messages due that are not sent, also those given up; return their number."""
        with self._writing() as connection:
            again = outbox.update().where(outbox.c.sent_s.is_(None))
            return connection.execute(again.values(attempts=0, due_s=0.0)).rowcount


def _revisions(connection: Connection) -> dict[int, int]:
    chosen = sql.select(suspensions.c.id, suspensions.c.revision)
    return {row[0]: row[1] for row in connection.execute(chosen)}


class _Fleet:
    """Alarms of all suspensions with what messages say about them.

    Unreadable rows are left out and appended to `bad`.
    """

    def __init__(self, connection: Connection, bad: list[BadRow]) -> None:
        self.revisions = _revisions(connection)
        by_number = known_suspensions(connection, bad=bad)
        self.ids = {key: number for number, (key, _) in by_number.items()}
        self.alarms = read_stored(connection, Alarm, bad)
        self.seen = read_stored(connection, Acknowledgement, bad)
        open_ids = [
            self.ids[key]
            for key, alarms in self.alarms.items()
            if key in self.ids and any(alarm.is_open for alarm in alarms)
        ]
        newest = sql.select(trips.c.suspension_id, sql.func.max(trips.c.mileage_km))
        newest = newest.where(is_one_of(trips.c.suspension_id, open_ids))
        rows = connection.execute(newest.group_by(trips.c.suspension_id))
        self.newest_km = {row[0]: row[1] for row in rows}
        of_last = trips.alias()
        last = sql.select(sql.func.max(of_last.c.mileage_km)).where(of_last.c.status == OK)
        last = last.where(of_last.c.suspension_id == trips.c.suspension_id)
        chosen = sql.select(trips.c.suspension_id, trips.c.worn).where(
            is_one_of(trips.c.suspension_id, open_ids), trips.c.mileage_km == last.scalar_subquery()
        )
        self.worn = {row[0]: parts_of(restored(row[1])) for row in connection.execute(chosen)}

    def up_to_km(self, key: Key, alarm: Alarm) -> float:
        """Return the mileage up to which an alarm is known."""
        if not alarm.is_open:
            return alarm.end_km
        return max(self.newest_km.get(self.ids[key]) or alarm.begin_km, alarm.begin_km)

    def entry(self, key: Key, alarm: Alarm, state: str) -> dict[str, Any]:
        """Return an alarm as messages contain it."""
        by = newest_of(alarm, self.seen.get(key, []))
        names = {"vehicle": key[0], **asdict(key[1])}
        subject = {"parameter": alarm.parameter, "cause": str(alarm.cause)}
        worn = self.worn.get(self.ids[key], ()) if alarm.is_open else ()
        named = [
            part
            for part in worn
            if isinstance(part, Finding) and alarm.parameter in part.values.get("names", ())
        ]
        event = [*names.values(), *subject.values(), int(alarm.severity), alarm.begin_km]
        return {
            "event": _digest(*event),
            "state": state,
            **names,
            "place": str(key[1]),
            **subject,
            "severity": str(alarm.severity),
            "begin_km": alarm.begin_km,
            "end_km": or_null(alarm.end_km),
            "reason": alarm.words,
            "findings": as_plain(together((alarm.words, *named))),
            "acknowledged_by": by.by if by else "",
        }


OF = ("suspension_id", "parameter", "cause")
"""What alarms share of which the last reported one is noted."""


def _queue(
    connection: Connection, recipient: Recipient, fleet: _Fleet, now: datetime, zone: tzinfo | None
) -> int:
    """Queue the messages of a recipient that are due, and note what they contain."""
    # a row that is never sent says since when the recipient is known
    name, local = recipient.name, now.astimezone(zone)
    is_first = _insert(connection, _digest(name, START), name, ("", ""), START, {}, now)
    # the id of a message follows from what it says, so that none is queued twice
    today = local.date().isoformat()
    of_today = _digest(name, "digest", today)
    is_due = recipient.digest is not None and local.time() >= recipient.digest
    is_due &= not any(_has(connection, _digest(of_today, *to)) for to in recipient.targets)
    urgent, listed = _chosen(connection, recipient, fleet, is_first, is_due)
    messages: list[tuple[str, str, dict[str, Any]]] = []
    if urgent:
        about = _digest(name, "alarms", *sorted(entry["event"] for entry in urgent))
        messages.append((about, "alarms", {"alarms": urgent}))
    if is_due:  # active alarms first, then the most severe
        listed.sort(key=lambda entry: (entry["end_km"] is not None, entry["severity"] != "act"))
        n_own = sum(recipient.is_about(key) for key in fleet.ids)
        content = {"day": today, "alarms": listed, "n_suspensions": n_own}
        messages.append((of_today, "digest", content))
    return sum(
        _insert(connection, _digest(about, *to), name, to, kind, content, now)
        for about, kind, content in messages
        for to in recipient.targets
    )


def _chosen(
    connection: Connection, recipient: Recipient, fleet: _Fleet, is_first: bool, is_due: bool
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the alarms to send at once and those of a digest, and note them as reported."""
    chosen = sql.select(told).where(told.c.recipient == recipient.name)
    reported = {
        tuple(r[name] for name in OF): _Reported(r["severity"], r["at_km"], bool(r["is_open"]))
        for r in connection.execute(chosen).mappings()
    }
    urgent: list[dict[str, Any]] = []
    listed: list[dict[str, Any]] = []
    notes: dict[tuple[Any, ...], _Reported] = {}
    for key, alarms in fleet.alarms.items():
        if not recipient.is_about(key) or key not in fleet.ids:
            continue
        identified = [((fleet.ids[key], a.parameter, str(a.cause)), a) for a in alarms]
        # the last alarm that starts up to the noted mileage is the one that was reported
        last = {
            of: a for of, a in identified if of in reported and a.begin_km <= reported[of].at_km
        }
        for of, alarm in identified:
            before = reported.get(of)
            state = before.state(alarm, alarm is last.get(of)) if before else "new"
            is_news = state in ("new", "worse")
            is_urgent = alarm.is_open and is_news and alarm.severity in recipient.at_once
            # cleared before the recipient was known: no news to it
            is_past = is_first and not alarm.is_open
            is_listed = alarm.is_open or (state not in ("old", "known") and not is_past)
            is_listed &= is_due and alarm.severity in recipient.severities | recipient.at_once
            entry = fleet.entry(key, alarm, state) if is_urgent or is_listed else {}
            urgent += [entry] * is_urgent
            listed += [entry] * is_listed
            # a known alarm is noted up to the newest trip: a late trip may move its start
            if is_urgent or is_listed or is_past or (state == "known" and alarm.is_open):
                severity = int(alarm.severity)
                if state == "known" and before:  # once reported as act, always
                    severity = max(severity, before.severity)
                notes[of] = _Reported(severity, fleet.up_to_km(key, alarm), alarm.is_open)
    changed = [
        {"recipient": recipient.name, **dict(zip(OF, of, strict=True)), **asdict(note)}
        | {"is_open": int(note.is_open)}
        for of, note in notes.items()
        if reported.get(of) != note
    ]
    upsert(connection, told, changed)
    return urgent, listed


def _insert(
    connection: Connection,
    number: str,
    recipient: str,
    target: tuple[str, str],
    kind: str,
    content: dict[str, Any],
    now: datetime,
) -> bool:
    """Queue a message unless it is queued already; return whether it is new."""
    if _has(connection, number):
        return False
    created = now.astimezone(UTC).isoformat(timespec="seconds")
    whole = {"id": number, "kind": kind, "recipient": recipient, "created": created} | content
    row = {
        "id": number,
        "recipient": recipient,
        "channel": target[0],
        "address": target[1],
        "kind": kind,
        "content": json_bytes(whole).decode(),
        "created_s": now.timestamp(),
        "due_s": 0.0,
        "leased_s": 0.0,
        "attempts": 0,
        "sent_s": now.timestamp() if kind == START else None,
        "error": "",
    }
    connection.execute(outbox.insert().values(row))
    return True


def _waiting() -> Condition:
    return sql.and_(outbox.c.sent_s.is_(None), outbox.c.attempts < MOST_ATTEMPTS)


def _due(now_s: float) -> Condition:
    """Return the condition that a message is to be sent now, and that no program sends it.

    A time further ahead than any wait was written before the clock was set back; it is over.
    """
    ends = (outbox.c.due_s, LONGEST_WAIT_S), (outbox.c.leased_s, LEASE_S)
    is_over = (sql.or_(end_s <= now_s, end_s > now_s + most_s) for end_s, most_s in ends)
    return sql.and_(_waiting(), *is_over)


def _has(connection: Connection, number: str) -> bool:
    return bool(connection.execute(sql.select(sql.exists().where(outbox.c.id == number))).scalar())


def _update(connection: Connection, number: str, **values: Any) -> None:
    connection.execute(outbox.update().where(outbox.c.id == number).values(**values))


def _digest(*content: Any) -> str:
    return content_hash(content)[:32]
