"""Sentences that other packages compose in English, and how pages say them in another language.

A reason such as "the last trip is at 62.1 % of healthy, below the act limit of 70 %" is data: it is
stored, logged and written to tables in English. ``spoken`` finds the pattern that it was composed
by, and fills in the pattern's translation. The patterns are in sentences.txt.
"""

from __future__ import annotations

import functools
import re
import string
from collections.abc import Iterator
from importlib import resources
from typing import IO, Any

from suspnet.ground.findings import LIST, OF, TEMPLATES, Finding
from suspnet.report.language import ENGLISH, current, day, decimal, gettext, ngettext


def extract(file: IO[bytes], *_: Any, **__: Any) -> Iterator[tuple[int, None, str, list[str]]]:
    """Yield line and text of each pattern in the file of patterns, for ``pybabel extract``."""
    for number, line in enumerate(file.read().decode().splitlines(), 1):
        if not line.startswith("#"):
            yield number, None, line.replace(r"\n", "\n"), []


with resources.files("suspnet.report").joinpath("sentences.txt").open("rb") as _file:
    PATTERNS = tuple(text for _, _, text, _ in extract(_file))
"""Patterns of sentences; what is in braces varies, and is translated in the same way."""
_SENSOR = re.compile(
    r"(axle_box|bogie|frame|body)(?:[ _](axle\d|centre))?(?:[ _](left|right|middle))?"
    r"(?![\w`/]|\.\w)"
)
"""A sensor by its name in manifests or in layouts: "axle_box axle2 left", "frame_centre_left"."""
_SENSORS = re.compile(
    rf"(?:^|(?<=; )|(?<=: )|(?<=sensor )){_SENSOR.pattern}(?=: |, | \(|$)"
    rf"|(?<![\w.`/])(?=axle_box|\w+_(?:axle\d|centre|left|right|middle)){_SENSOR.pattern}"
)
"""Sensors within a text: names that it begins with, and those with an underscore anywhere."""
_PLACES = {"axle_box": "axle box", "bogie": "bogie frame", "frame": "bogie frame"}
SEPARATORS = ("\n", "; ", ". ", ": ", ", ")
"""What joins sentences and places, tried in this order where no pattern has the whole text."""
LONGEST = 800
"""Length of a text above which it is not translated: its patterns would take too long."""


def spoken(text: str) -> str:
    """Return a composed English text in the current language; what has no pattern stays as it is.

    Examples
    --------
    >>> from suspnet.report.language import speaking
    >>> with speaking("de"):
    ...     spoken("the last trip is at 62.1 % of healthy, below the act limit of 70 %")
    'die letzte Fahrt liegt bei 62,1 % des Referenzwerts, unter der Eingriffsgrenze von 70 %'
    """
    if isinstance(text, Finding):
        return _rendered(text)
    if current() == ENGLISH:
        return _SENSORS.sub(_sensor_words, text)
    if len(text) > LONGEST:  # a list may be long, as of faults
        each = text.split("; ")
        return text if len(each) == 1 else "; ".join(map(spoken, each))
    said = _spoken(text, current())
    return _SENSORS.sub(lambda name: _spoken(_sensor_words(name), current()), said)


class _Spoken(string.Formatter):
    """Fills in a template: texts are spoken in turn, numbers have their language's decimal sign."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return one value of a template in the current language."""
        if isinstance(value, str):
            return spoken(value)
        return decimal(format(value, format_spec))


_FILL = _Spoken()


def _rendered(found: Finding) -> str:
    """Return a finding in the current language."""
    values = dict(found.values)
    if found.kind == LIST:
        return str(values["separator"]).join(map(spoken, values["parts"]))
    if found.kind == OF and (sensor := _SENSOR.fullmatch(values["name"])):
        values["name"] = _sensor_words(sensor)
    one, *many = TEMPLATES[found.kind]
    said = ngettext(one, *many, values["n"]) if many else gettext(one)
    return _FILL.vformat(said, (), values)


@functools.lru_cache(maxsize=10_000)
def _spoken(text: str, language: str) -> str:
    """Return a text in a language, which is the current one: it is an argument for the cache."""
    if sensor := _SENSOR.fullmatch(text):
        text = _sensor_words(sensor)
    if re.fullmatch(r"\d{4}-\d\d-\d\d(?: \d\d:\d\d:\d\d(?:[+-]\d\d:\d\d)?)?", text):
        return day(text)
    if re.fullmatch(r"[-+\N{MINUS SIGN}]?[\d \N{NO-BREAK SPACE}]*\.?\d+(?:e[-+]?\d+)?%?", text):
        return decimal(text)
    if (said := _matched(text, language)) is not None:
        return said
    # names of a file, a sensor or a trip stand before a sentence
    head, _, rest = text.partition(": ")
    if rest and (said := _matched(rest, language)) is not None:
        return f"{_spoken(head, language)}: {said}"
    if text.endswith(".") and (said := _matched(text[:-1], language)) is not None:
        return f"{said}."
    for separator in SEPARATORS:
        if separator in text:
            end = "." * (separator == ". ")  # a sentence is known with its full stop
            *parts, last = text.split(separator)
            each = [_spoken(one + end, language).removesuffix(end) for one in parts]
            return separator.join([*each, _spoken(last, language)])
    return f"{_spoken(text[:-1], language)}." if text.endswith(".") else text


def _sensor_words(name: re.Match[str]) -> str:
    """Return a sensor's place in words: "axle box of axle 2, left" of "axle_box axle2 left"."""
    place, *where = filter(None, name.groups())
    words = _PLACES.get(place, "car body")
    for one in where:
        words += f" of axle {one[4:]}" if one.startswith("axle") else f", {one}"
    return words


def _matched(text: str, language: str) -> str | None:
    """Return the translation of a text that one pattern has as a whole; None if there is none."""
    if text in _WHOLE:
        return gettext(text)
    for pattern, expression in _expressions():
        if found := expression.fullmatch(text):
            values = {
                name: value if name == "typed" else _spoken(value, language)
                for name, value in found.groupdict().items()
            }
            return gettext(pattern).format(**values)
    return None


_WHOLE = frozenset(one for one in PATTERNS if "{" not in one)


@functools.cache
def _expressions() -> list[tuple[str, re.Pattern[str]]]:
    """Return the patterns with variable parts as regular expressions, the longest first."""
    found = []
    for pattern in PATTERNS:
        parts = re.split(r"\{(\w+)\}", pattern)
        if len(parts) > 1:
            source = "".join(
                _group(part) if i % 2 else re.escape(part) for i, part in enumerate(parts)
            )
            found.append((sum(map(len, parts[::2])), pattern, re.compile(source)))
    found.sort(key=lambda one: -one[0])
    return [(pattern, expression) for _, pattern, expression in found]


NUMBERS = frozenset({"k", "n", "j", "m", "size", "value", "limit", "km", "factor", "own", "other"})
"""Variable parts that are numbers: no other text matches them."""

PART = "(?:[kc]_[ps]|(?:secondary )?(?:damper|spring))"
OF_NAME = {
    "quantity": "[kc]_[ps]",
    "one": f"{PART}.*?",
    "another": f"{PART}.*",
    "where": "(?:(?! or ).)+",
    "odds": r"[\w ]+ : 1",
    "channel": r"\w+",
    "partner": r"\w+",
    "kind": r"\w+",
    "side": r"\w+",
    "beyond": "(?:(?!; ).)+",
    "fate": r"\w+(?: usable)?",
    "trip": r"\S+",
    "key": "`[^`]+`",
    "listed": r"\[[^\]]*\]|\([^)]*\)",
    "named_file": r"\S*\.\w+",
    "rule": r"a mapping|text \(put .*|one of [\[(].*[\])]|a number (?:>|from) ?[^,]*"
    "|a finite number|at most .* km .*|a time like .*|one line of at most .* characters",
}
"""Regular expressions of some variable parts."""


def _group(name: str) -> str:
    if name in ("visits", "jobs", "waiting", "quiet"):
        return rf"(?P<{name}>\d+ [\w ]+)"
    if name in ("day", "today"):
        return rf"(?P<{name}>\d+-\d+-\d+)"
    if name in ("low", "high"):
        return rf"(?P<{name}>[\d \N{{NO-BREAK SPACE}}.-]+|no end)"
    if name in OF_NAME:
        return rf"(?P<{name}>{OF_NAME[name]})"
    if name in NUMBERS:
        return rf"(?P<{name}>[-+]?[\d \N{{NO-BREAK SPACE}}.,]*\d(?:e[-+]?\d+)?|inf|nan)"
    return rf"(?P<{name}>{'.*?' if name in ('unknown', 'common') else '.+?'})"
