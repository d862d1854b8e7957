"""Tables of the history, the same in SQLite and PostgreSQL.

A trip is known by its suspension and its key: a hash of name, start and mileage. One that was
kept without its start is replaced when it is known. NaN is NULL. The
columns that a view of the whole fleet reads come first: SQLite reads a row only as far as it must.
"""

from __future__ import annotations

from dataclasses import fields

from sqlalchemy import (
    BigInteger,
    Column,
    Double,
    ForeignKey,
    ForeignKeyConstraint,
    Integer,
    LargeBinary,
    MetaData,
    String,
    Table,
    UniqueConstraint,
)

from suspnet.dynamics import PARAMETERS
from suspnet.history.records import Quality

SCHEMA = 3
"""Version of the tables; a store of another version is refused."""

metadata = MetaData()

versions = Table("suspnet_version", metadata, Column("schema", Integer, primary_key=True))

PLACE = ("train", "car", "suspension", "bogie", "side")
"""Columns that say which suspension of which vehicle it is; empty where it is not said."""

suspensions = Table(
    "suspensions",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("vehicle", String, nullable=False),
    *(Column(name, String, nullable=False) for name in PLACE),
    Column("revision", BigInteger, nullable=False, server_default="0"),
    UniqueConstraint("vehicle", *PLACE),
)
"""The revision grows with each transaction that changes what is kept of a suspension."""

NUMBERS = ("mileage_km", "healthy_since_km", "temperature_c", "seconds")
TEXTS = ("trip", "start", "flags", "status", "reason", "sides", "manifest")
"""Columns of a trip's numbers and texts, named as in its result."""
QUALITY = {"float": Double, "int": Integer, "str": String}
"""Type of the column of each field of a trip's quality, by the type of the field."""
VALUES = {
    "estimates": "{}",
    "half_widths": "{}_half_width",
    "raw": "{}_raw",
    "truth": "{}_truth",
    "healthy_si": "{}_healthy_si",
    "healthy_half_widths": "{}_healthy_half_width",
}
"""Numbers of each parameter, named as in a trip's result, and their columns."""

trips = Table(
    "trips",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("suspension_id", ForeignKey("suspensions.id", ondelete="CASCADE"), nullable=False),
    *(Column(name, Double) for name in NUMBERS),
    *(Column(column.format(name), Double) for column in VALUES.values() for name in PARAMETERS),
    *(Column(name, String, nullable=False) for name in TEXTS),
    *(Column(one.name, QUALITY[str(one.type)]) for one in fields(Quality)),
    Column("key", LargeBinary(16), nullable=False),
    UniqueConstraint("suspension_id", "key"),
)

curves = Table(
    "curves",
    metadata,
    Column("suspension_id", Integer, primary_key=True),
    Column("key", LargeBinary(16), primary_key=True),
    Column("arrays", LargeBinary, nullable=False),
    Column("sha256", String(64), nullable=False),
    ForeignKeyConstraint(
        ["suspension_id", "key"], ["trips.suspension_id", "trips.key"], ondelete="CASCADE"
    ),
)
"""Curves of some of the trips: arrays in the safetensors format, and the hash of these bytes."""

events = Table(
    "events",
    metadata,
    Column("suspension_id", ForeignKey("suspensions.id", ondelete="CASCADE"), primary_key=True),
    Column("mileage_km", Double, primary_key=True),
    Column("kind", String, primary_key=True),
    Column("words", String, nullable=False),
)

alarms = Table(
    "alarms",
    metadata,
    Column("suspension_id", ForeignKey("suspensions.id", ondelete="CASCADE"), primary_key=True),
    Column("begin_km", Double, primary_key=True),
    Column("parameter", String, primary_key=True),
    Column("cause", String, primary_key=True),
    Column("severity", Integer, nullable=False),
    Column("end_km", Double),
    Column("words", String, nullable=False),
)

acknowledgements = Table(
    "acknowledgements",
    metadata,
    Column("suspension_id", ForeignKey("suspensions.id", ondelete="CASCADE"), primary_key=True),
    Column("at_km", Double, primary_key=True),
    Column("at", String, primary_key=True),
    Column("parameter", String, primary_key=True),
    Column("cause", String, primary_key=True),
    Column("by", String, primary_key=True),
    Column("severity", Integer, nullable=False),
    Column("words", String, nullable=False),
)
