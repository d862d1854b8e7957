"""Overviews of suspensions in a store, with which a server shows a fleet before it evaluates it."""

from collections.abc import Collection
from dataclasses import asdict, dataclass, fields

import sqlalchemy as sql
from sqlalchemy.engine import Connection

from suspnet.ground.records import Key
from suspnet.trains.history.schema import check_types, is_one_of, known_suspensions, overviews


@dataclass(frozen=True)
class StoredOverview:
    """Overview of a suspension.

    `content` is its text, of the trips of `revision`; `fingerprint` is the hash of the settings and
    the program that it depends on.
    """

    revision: int
    fingerprint: str
    content: str


def read_overviews(connection: Connection, keys: Collection[Key]) -> dict[Key, StoredOverview]:
    """Return the stored overviews of suspensions; unreadable ones are left out."""
    key_of = {number: key for number, (key, _) in known_suspensions(connection).items()}
    wanted = [number for number, key in key_of.items() if key in keys]
    names = [field.name for field in fields(StoredOverview)]
    chosen = sql.select(overviews).where(is_one_of(overviews.c.suspension_id, wanted))
    stored = {}
    for row in connection.execute(chosen).mappings():
        try:
            check_types(overviews, row)
        except ValueError:
            continue
        key = key_of[row["suspension_id"]]
        stored[key] = StoredOverview(**{name: row[name] for name in names})
    return stored


def overview_row(suspension: int, overview: StoredOverview) -> dict[str, int | str]:
    """Return an overview as a row of its table."""
    return {"suspension_id": suspension, **asdict(overview)}
