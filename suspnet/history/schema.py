"""Tables of the history, the same in SQLite and PostgreSQL.

A trip is known by its suspension and its key: a hash of name, start and mileage. NaN is NULL.
"""

from __future__ import annotations

from sqlalchemy import (
    JSON,
    Column,
    Double,
    ForeignKey,
    Integer,
    MetaData,
    String,
    Table,
    UniqueConstraint,
)

SCHEMA = 1
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
    UniqueConstraint("vehicle", *PLACE),
)

TEXTS = ("trip", "manifest", "start", "status", "reason", "flags", "sides")
NUMBERS = ("mileage_km", "healthy_since_km", "seconds")
"""Columns of a trip's texts and numbers, named as in its result."""

trips = Table(
    "trips",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("suspension_id", ForeignKey("suspensions.id", ondelete="CASCADE"), nullable=False),
    Column("key", String(64), nullable=False),
    *(Column(name, String, nullable=False) for name in TEXTS),
    *(Column(name, Double) for name in NUMBERS),
    Column("quality", JSON, nullable=False),
    UniqueConstraint("suspension_id", "key"),
)

VALUES = ("estimates", "raw", "truth", "half_widths", "healthy_si", "healthy_half_widths")
"""Columns of numbers of each parameter, named as in a trip's result."""

estimates = Table(
    "estimates",
    metadata,
    Column("trip_id", ForeignKey("trips.id", ondelete="CASCADE"), primary_key=True),
    Column("parameter", String, primary_key=True),
    *(Column(name, Double) for name in VALUES),
)

events = Table(
    "events",
    metadata,
    Column("id", Integer, primary_key=True),
    Column("suspension_id", ForeignKey("suspensions.id", ondelete="CASCADE"), nullable=False),
    Column("mileage_km", Double, nullable=False),
    Column("kind", String, nullable=False),
    Column("words", String, nullable=False),
    UniqueConstraint("suspension_id", "mileage_km", "kind"),
)
