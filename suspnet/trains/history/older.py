"""Stores of older versions: what programs look for in their sentences becomes findings, once."""

from __future__ import annotations

import re

import sqlalchemy as sql
from sqlalchemy.engine import Connection

from suspnet.ground.findings import (
    NO_PART,
    WITHOUT_SENSORS,
    WORN,
    WORN_ONE_OF,
    Finding,
    at,
    stored,
    together,
)
from suspnet.ground.parameters import BOGIE_PARTS, part_words
from suspnet.trains.history.schema import trips

FINDINGS = 9
"""Version from which findings are stored as kind and values; before, as sentences."""
_WORN = re.compile(r"([^;]+?) at ([\d.e+]+) % of healthy \(odds (over )?([\d.]+) : 1(, [^;)]*)?\)")
_NO_PART = "no part is named: "
_FAILING = re.compile(
    r"(?:^|; )([\w ]+): ((?:(dead) and left out|loose from) .*?)(?=; [a-z_]+(?: [\w ]+)?: |$)"
)
_WITHOUT = "parts are read without the sensors of "
_PARTS = {part_words(name): name for name in BOGIE_PARTS}


def store_findings(connection: Connection) -> None:
    """Turn the sentences on worn parts, why none is named, and failing sensors into findings.

    All other sentences stay as they are: nothing looks into them, and pages show them in English.
    """
    columns = {"worn": worn_findings, "warnings": warning_findings, "faults": fault_findings}
    chosen = sql.or_(*(trips.c[name] != "" for name in columns))
    query = sql.select(trips.c.id, *(trips.c[name] for name in columns)).where(chosen)
    changed = [
        {"row": row.id} | {name: change(getattr(row, name)) for name, change in columns.items()}
        for row in connection.execute(query).all()
        if all(isinstance(getattr(row, name), str) for name in columns)
    ]
    if changed:
        update = trips.update().where(trips.c.id == sql.bindparam("row"))
        connection.execute(update, changed)


def worn_findings(worn: str) -> str:
    """Return the column of worn parts; a text of another form stays as it is."""
    findings = []
    for sentence in worn.split("; "):
        match = _WORN.fullmatch(sentence)
        names = tuple(map(_PARTS.get, match[1].split(" or "))) if match else (None,)
        if match is None or None in names:
            return worn
        odds = Finding("odds-over" if match[3] else "odds", odds=float(match[4]))
        where, kind = together(match[1].split(" or "), " or "), WORN_ONE_OF if match[5] else WORN
        percent = float(match[2])
        findings.append(Finding(kind, names=names, where=where, percent=percent, odds=odds))
    return stored(together(findings))


def warning_findings(warnings: str) -> str:
    """Return the column of warnings, of which some say which parts or sensors are not read."""
    others, mark, why = warnings.partition(_NO_PART)
    findings: list[str] = []
    for sentence in filter(None, others.removesuffix("; ").split("; ")):
        names = sentence.removeprefix(_WITHOUT)
        values = {"names": tuple(names.split(", ")), "listed": names}
        findings.append(sentence if names == sentence else Finding(WITHOUT_SENSORS, **values))
    return stored(together([*findings, Finding(NO_PART, words=why)] if mark else findings))


def fault_findings(faults: str) -> str:
    """Return the column of faults, of which some are of a dead or a loose sensor."""
    findings, end = [], 0
    for match in _FAILING.finditer(faults):
        findings.append(faults[end : match.start()].removeprefix("; "))
        kind = "dead-before" if match[3] else "loose-before"
        findings.append(at(match[1], kind, words=match[2]))
        end = match.end()
    return stored(together([*findings, faults[end:].removeprefix("; ")]))
