"""Transfer functions of a few trips of each suspension: the first, and the newest."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass

import sqlalchemy as sql
from sqlalchemy.engine import Connection

from suspnet.ground.records import TripCurves, TripResult, or_nan, to_arrays, to_responses
from suspnet.ground.storage import DamagedFileError, dump_arrays, load_arrays
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.history.database import HistoryError, upsert
from suspnet.history.schema import curves, suspensions, trips

N_NEWEST = 3
"""Number of the newest trips whose curves are stored, besides those of the first."""
NAMES = ("frequencies_hz", "real", "imaginary", "coherences", "deviations")
"""Arrays of a trip as they are stored."""


ROW = (str, int | float | None, str, bytes | memoryview, str)
"""Types of a row: name, mileage and start of a trip, its arrays and their hash."""


@dataclass(frozen=True, eq=False)
class TripResponses:
    """Transfer functions of one trip, as the store holds them.

    Attributes
    ----------
    trip : str
    mileage_km : float, [km]
    start : str
        ISO 8601, or empty.
    frequencies_hz : array of shape (n_freq,), [Hz]
    responses : complex array of shape (2, n_freq), [-]
        G_p and G_s.
    coherences, deviations : arrays of shape (2, n_freq), [-]
        Deviation: standard deviation of the log-magnitude.
    """

    trip: str
    mileage_km: float
    start: str
    frequencies_hz: FloatArray
    responses: ComplexArray
    coherences: FloatArray
    deviations: FloatArray


Order = tuple[int, float, str, str]


def order(mileage_km: float, start: str, trip: str) -> Order:
    """Return the place of a trip among those of its suspension: by mileage, start and name.

    Trips without a mileage come first, so that they are never taken for the newest of others.
    """
    known = not math.isnan(mileage_km)
    return int(known), mileage_km if known else 0.0, start, trip


def write_curves(
    connection: Connection, suspension: int, results: Mapping[bytes, TripResult]
) -> None:
    """Store the curves of a suspension's trips, as far as they are the first or the newest.

    Curves that were stored of these trips before are replaced, or deleted where a trip has none any
    more; so are those of trips that are no longer among the newest.

    Parameters
    ----------
    connection : Connection
        Of a transaction that has locked the suspension.
    suspension : int
        Its number in the store.
    results : mapping of TripResult
        Trips by their keys, of this suspension.
    """
    of_one = curves.c.suspension_id == suspension
    chosen = (
        sql.select(curves.c.key, trips.c.mileage_km, trips.c.start, trips.c.trip)
        .join(trips, _same_trip())
        .where(of_one)
    )
    there = {row[0]: order(or_nan(row[1]), row[2], row[3]) for row in connection.execute(chosen)}
    new = {key: one.curves for key, one in results.items() if one.curves is not None}
    orders = {key: order(r.mileage_km, r.start, r.trip) for key, r in results.items() if key in new}
    known = {key: place for key, place in there.items() if key not in results} | orders
    ordered = sorted(known, key=lambda key: known[key])
    kept = {*ordered[:1], *ordered[-N_NEWEST:]}
    gone = [{"of": suspension, "gone": key} for key in there if key not in kept]
    if gone:
        match = sql.and_(
            curves.c.suspension_id == sql.bindparam("of"), curves.c.key == sql.bindparam("gone")
        )
        connection.execute(curves.delete().where(match), gone)
    rows = [_row(suspension, key, found) for key, found in new.items() if key in kept]
    upsert(connection, curves, rows)


def read_responses(
    connection: Connection, where: sql.ColumnElement[bool], name: str
) -> list[TripResponses]:
    """Return the stored curves of a suspension, by mileage.

    Parameters
    ----------
    connection : Connection
    where : condition
        Chooses the suspension.
    name : str
        Of store and suspension, for the message of an error.

    Raises
    ------
    HistoryError
        If they were altered.
    """
    # NullType: whatever is there comes as it is, to be refused by name
    arrays = sql.type_coerce(curves.c.arrays, sql.types.NullType())
    columns = trips.c.trip, trips.c.mileage_km, trips.c.start, arrays, curves.c.sha256
    chosen = (
        sql.select(*columns).join_from(curves, trips, _same_trip()).join(suspensions).where(where)
    )
    rows = connection.execute(chosen).all()
    for row in rows:
        if not all(isinstance(one, kind) for one, kind in zip(row, ROW, strict=True)):
            raise HistoryError(f"{name}: a row of the curves or of their trips is damaged")
    rows = sorted(rows, key=lambda row: order(or_nan(row[1]), row[2], row[0]))
    return [_responses(*row, name=name) for row in rows]


def _same_trip() -> sql.ColumnElement[bool]:
    same = curves.c.suspension_id == trips.c.suspension_id, curves.c.key == trips.c.key
    return sql.and_(*same)


def _row(suspension: int, key: bytes, found: TripCurves) -> dict[str, object]:
    arrays = to_arrays(found)
    content = dump_arrays({name: arrays[name] for name in NAMES})
    digest = hashlib.sha256(content).hexdigest()
    return {"suspension_id": suspension, "key": key, "arrays": content, "sha256": digest}


def _responses(
    trip: str, mileage_km: float | None, start: str, content: bytes, sha256: str, *, name: str
) -> TripResponses:
    """Return curves from the bytes that are stored of them.

    Raises
    ------
    HistoryError
        If these were altered.
    """
    what = f"{name}: the stored curves of {trip}"
    try:
        arrays = load_arrays(bytes(content), what, sha256)
    except DamagedFileError as error:
        raise HistoryError(" ".join(str(error).split())) from None
    shapes = {key: one.shape for key, one in arrays.items()}
    both = (2, *shapes.get("frequencies_hz", ()))
    if shapes != dict.fromkeys(NAMES, both) | {"frequencies_hz": both[1:]} or len(both) != 2:
        raise HistoryError(f"{what} is damaged: it holds {shapes}")
    responses = to_responses(arrays.pop("real"), arrays.pop("imaginary"))
    return TripResponses(trip, or_nan(mileage_km), start, responses=responses, **arrays)
