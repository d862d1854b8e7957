"""A bogie from above: what is known of each of its twelve parts, for the macros of bogie.html."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from suspnet.ground.findings import Finding, parts_of, together
from suspnet.ground.parameters import BOGIE_PARTS, Severity, part_words
from suspnet.trains.maintenance.judge import ABSURD
from suspnet.trains.maintenance.plan import Plan, place_of
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.templates import level, shown_number

LEAST_HALF = 0.1  # smallest half width of an interval that is shown [% of healthy]
WIDE_HALF = 10.0  # half width of an interval from which no decimals are shown [% of healthy]
MAX_BOGIES = 6  # drawn on one page of a fleet
LETTERS = "ABCDEFGHIJKL"  # names of groups of parts


@dataclass(frozen=True)
class DrawnPart:
    """One part as it is drawn; `value` and `half` are in % of healthy, as text.

    `half` is empty without an interval, `group` unless the part is one of several of which one has
    worn, `odds` unless it alone is named as worn, and `visit` unless the plan has work on it.
    """

    name: str
    severity: str
    value: str
    half: str
    group: str = ""
    odds: str = ""
    visit: str = ""

    @property
    def words(self) -> str:
        """The part as a depot calls it."""
        return part_words(self.name)

    @property
    def worn(self) -> str:
        """Whether the part has worn, as text; empty without a verdict."""
        named = Finding("worn", odds=self.odds) if self.odds else ""
        return together((named, self.group and Finding("one-of-group", group=self.group)))

    @property
    def level(self) -> str:
        """Value and interval as text."""
        if not self.value:
            return "no estimate"
        text = f"{self.value} ± {self.half} %" if self.half else f"{self.value} %"
        return text.replace(" ", "\N{NO-BREAK SPACE}")


@dataclass(frozen=True)
class Bogie:
    """The twelve parts by name; `groups` has a sentence on each group of parts, by its letter."""

    parts: dict[str, DrawnPart]
    groups: dict[str, str]

    @property
    def listed(self) -> list[DrawnPart]:
        """Parts with a finding, a verdict or work planned, the worst first."""
        order = [str(severity) for severity in sorted(Severity, reverse=True)]
        shown = [p for p in self.parts.values() if p.severity != "none" or p.worn or p.visit]
        return sorted(shown, key=lambda part: order.index(part.severity))


def bogie_of(state: State, plan: Plan | None = None) -> Bogie | None:
    """Return the bogie of a suspension; None if no trip has an estimate of its parts.

    Value and interval of a part are medians of its ``State.leading`` trips, of the interval those
    of them that are not flagged. Verdicts are those of the newest trip with an estimate of parts.
    """
    if not set(BOGIE_PARTS) & set(state.outputs):
        return None
    entries, visits = worn_entries(state.worn), visits_of(plan, state)
    groups = dict(zip(LETTERS, (entry for entry in entries if len(entry[0]) > 1), strict=False))
    odds = {names[0]: text for names, text in entries if len(names) == 1}
    parts = {}
    for name in BOGIE_PARTS:
        severity = state.severities.get(name, Severity.UNKNOWN)
        letters = " ".join(letter for letter, (names, _) in groups.items() if name in names)
        verdict = letters, odds.get(name, ""), visits.get(name, "")
        parts[name] = DrawnPart(name, str(severity), *_level(state, name), *verdict)
    return Bogie(parts, {letter: group_words(*group) for letter, group in groups.items()})


def bogies_shown(
    entries: Iterable[tuple[str, str, State]], plan: Plan | None = None
) -> dict[str, Any]:
    """Return the bogies of suspensions, those with findings first, for the macro `fleet`.

    `entries` are the place, the name in URLs and the state of each. The values are "bogies", each
    with its place and name, and "n_bogies", the number of bogies whose parts are read.
    """
    with_parts = [entry for entry in entries if set(BOGIE_PARTS) & set(entry[2].outputs)]
    worst = sorted(with_parts, key=lambda entry: -entry[2].severity)[:MAX_BOGIES]
    return {
        "bogies": [(where, name, bogie_of(state, plan)) for where, name, state in worst],
        "n_bogies": len(with_parts),
    }


def _level(state: State, name: str) -> tuple[str, str]:
    """Return value and half width of the interval of a part, [% of healthy], as text."""
    if name not in state.outputs or not len(state.last_of(name).values):
        return "", ""
    last, now = state.leading(name), state.now(name)
    halves = 100 * (last.high - last.low)[~last.flagged] / 2
    half = float(np.median(halves)) if len(halves) else math.nan
    if not math.isfinite(half) or now > ABSURD:
        return level(now, 1), ""
    digits = 0 if half >= WIDE_HALF else 1
    return level(now, digits), shown_number(max(half, LEAST_HALF), digits)


def small_figures(state: State, images: Mapping[str, str]) -> dict[bool, list[dict[str, str]]]:
    """Return trends for the macro `multiples`, the worst first: True with a finding, False without.

    `images` are the figures, or their addresses, by the name of the parameter.
    """
    figures: dict[bool, list[dict[str, str]]] = {True: [], False: []}
    severities = {name: state.severities.get(name, Severity.NONE) for name in images}
    for name in sorted(images, key=lambda name: -severities[name]):
        figure = {"name": name, "severity": str(severities[name]), "image": images[name]}
        figures[severities[name] > Severity.NONE].append(figure)
    return figures


def worn_entries(worn: str) -> list[tuple[tuple[str, ...], str]]:
    """Return parts and odds of each entry of ``TripResult.worn``; several parts are a group."""
    return [
        (entry.values["names"], entry.values["odds"])
        for entry in parts_of(worn)
        if isinstance(entry, Finding) and "names" in entry.values
    ]


def group_words(names: Sequence[str], odds: str) -> str:
    """Return a sentence on parts of which one has worn."""
    parts = together(map(part_words, names), " or ")
    return Finding("one-of-several-worn", odds=odds, parts=parts)


def visits_of(plan: Plan | None, state: State) -> dict[str, str]:
    """Return the work on each part of a suspension that has a visit: what, and on which day."""
    place = place_of(state)
    return {
        job.part.parameter: visit.words_of(job)
        for visit in (plan.visits if plan else ())
        if visit.train == place[0]
        for job in visit.jobs
        if job.part.place == place and job.part.parameter in BOGIE_PARTS
    }
