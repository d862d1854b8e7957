"""Stores of older versions: what programs look for in their sentences becomes findings, once."""

from __future__ import annotations

import re

import sqlalchemy as sql
from sqlalchemy.engine import Connection

from suspnet.ground.findings import NO_PART, WORN, WORN_ONE_OF, Finding, joined, stored
from suspnet.ground.parameters import BOGIE_PARTS, part_words
from suspnet.history.schema import trips

FINDINGS = 9
"""Version from which findings are stored as kind and values; before, as sentences."""
_WORN = re.compile(r"([^;]+?) at ([\d.e+]+) % of healthy \(odds (over )?([\d.]+) : 1(, [^;)]*)?\)")
_NO_PART = "no part is named: "
_PARTS = {part_words(name): name for name in BOGIE_PARTS}


def store_findings(connection: Connection) -> None:
    """Turn the sentences on worn parts, and on why none is named, into findings.

    All other sentences stay as they are: nothing looks into them, and pages show them in English.
    """
    chosen = (trips.c.worn != "") | trips.c.warnings.contains(_NO_PART)
    query = sql.select(trips.c.id, trips.c.worn, trips.c.warnings).where(chosen)
    changed = [
        {"row": id_, "worn": worn_findings(worn), "warnings": warning_findings(warnings)}
        for id_, worn, warnings in connection.execute(query).all()
        if isinstance(worn, str) and isinstance(warnings, str)
    ]
    if changed:
        update = trips.update().where(trips.c.id == sql.bindparam("row"))
        connection.execute(update, changed)


def worn_findings(worn: str) -> str:
    """Return the column of worn parts; a text of another form stays as it is."""
    found = []
    for one in worn.split("; "):
        match = _WORN.fullmatch(one)
        names = [_PARTS.get(name) for name in match[1].split(" or ")] if match else [None]
        if match is None or None in names:
            return worn
        odds = Finding("odds-over" if match[3] else "odds", odds=float(match[4]))
        where, kind = joined(match[1].split(" or "), " or "), WORN_ONE_OF if match[5] else WORN
        found.append(Finding(kind, names=names, where=where, percent=float(match[2]), odds=odds))
    return stored(joined(found))


def warning_findings(warnings: str) -> str:
    """Return the column of warnings, whose last may say why no part is named."""
    others, mark, why = warnings.partition(_NO_PART)
    others = others.removesuffix("; ")
    return stored(joined((others, Finding(NO_PART, words=why)))) if mark else warnings
