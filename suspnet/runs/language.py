"""Language of the pages: gettext catalogues of the package, English where no other is chosen."""

import functools
import gettext as catalogues
import re
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import resources
from typing import Any

from suspnet.ground.findings import LIST, OF, TEMPLATES, Filling, Finding, together

ENGLISH = "en"
LANGUAGES = (ENGLISH, "de")
"""Languages of the pages. All texts are written in the first; the others have a catalogue."""
DOMAIN = "suspnet"
_current: ContextVar[str] = ContextVar("language", default=ENGLISH)


def check_language(name: str | None) -> None:
    """Raise ValueError unless there is a language of this name."""
    if name not in LANGUAGES:
        raise ValueError(f"`language` must be one of {', '.join(LANGUAGES)}, got {name!r}")


def current() -> str:
    """Return the language of the texts that this thread writes."""
    return _current.get()


def choose(language: str) -> None:
    """Set the language of the texts that this thread writes from now on."""
    check_language(language)
    _current.set(language)


@contextmanager
def speaking(language: str) -> Iterator[None]:
    """Write texts in a language inside a ``with`` block, then in the one before."""
    check_language(language)
    before = _current.set(language)
    try:
        yield
    finally:
        _current.reset(before)


@functools.cache
def catalogue(language: str) -> catalogues.NullTranslations:
    """Return the catalogue of a language; English has none."""
    folder = str(resources.files("suspnet.trains.pages") / "locale")
    return catalogues.translation(DOMAIN, folder, [language], fallback=language == ENGLISH)


def gettext(text: str) -> str:
    """Return a text in the current language, in English if the catalogue lacks it."""
    return catalogue(current()).gettext(text) if text else ""


def ngettext(singular: str, plural: str, n: int) -> str:
    """Return the singular or the plural of a text for a number, in the current language."""
    return catalogue(current()).ngettext(singular, plural, n)


def N_(text: str) -> str:  # noqa: N802 - the usual name of this mark
    """Return a text as it is: it marks one that is translated where it is shown."""
    return text


def decimal(text: str) -> str:
    """Return a number with the decimal sign of the current language."""
    return text if current() == ENGLISH else text.replace(".", ",")


def day(text: str) -> str:
    """Return a day in ISO 8601, and a time of day after it, as the current language writes days.

    >>> with speaking("de"):
    ...     day("2026-11-27")
    '27.11.2026'
    >>> with speaking("de"):
    ...     day("2026-11-27 02:27:19+00:00")
    '27.11.2026, 02:27 UTC'
    """
    if current() == ENGLISH:
        return text
    text = re.sub(r" (\d\d:\d\d):\d\d(?=[+-])", r", \1 ", text).replace("+00:00", "UTC")
    return re.sub(r"(\d+)-(\d\d)-(\d\d)", r"\3.\2.\1", text)


def spoken(text: str) -> str:
    """Return a finding in the current language, or a name, a day or a number on its own.

    Any other text stays as it is.

    >>> with speaking("de"):
    ...     spoken(Finding("act-since", km=56_000.0))
    'Eingriff nötig seit 56 000 km'
    """
    if isinstance(text, Finding):
        return _of_finding(text)
    if (sensor := _SENSOR.fullmatch(text)) and text not in ("bogie", "frame", "body"):
        return spoken(_of_sensor(sensor))
    if current() == ENGLISH:
        return text
    if _DAY.fullmatch(text):
        return day(text)
    return decimal(text) if _NUMBER.fullmatch(text) else gettext(text)


_DAY = re.compile(r"\d{4}-\d\d-\d\d(?: \d\d:\d\d:\d\d(?:[+-]\d\d:\d\d)?)?")
_NUMBER = re.compile(r"[-+\N{MINUS SIGN}]?[\d \N{NO-BREAK SPACE}]*\.?\d+(?:e[-+]?\d+)?%?")
_SENSOR = re.compile(
    r"(axle_box|bogie|frame|body)(?:[ _](axle\d|centre))?(?:[ _](left|right|middle))?"
)
"""A sensor by its name in manifests or in layouts: "axle_box axle2 left", "frame_centre_left"."""
_NAMING = (OF, "sensor", "sensor-name")
"""Kinds whose `name` is that of a sensor also where it is one plain word, as "body"."""


def _of_sensor(sensor: re.Match[str]) -> str:
    """Return a sensor's place: "axle box of axle 2, left" of "axle_box axle2 left"."""
    place, where, side = sensor.groups(default="")
    words = {"axle_box": "axle box", "body": "car body"}.get(place, "bogie frame")
    if where.startswith("axle"):
        kind = "axle-box-of-axle" if place == "axle_box" else "frame-of-axle"
        return together((Finding(kind, n=where[4:]), side), ", ")
    return together((words, where, side), ", ")


class _Spoken(Filling):
    """Fills in a template: texts are spoken in turn, numbers have their language's decimal sign."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return one value of a template in the current language."""
        if isinstance(value, str):
            return spoken(value)
        text = super().format_field(value, format_spec)
        return text if format_spec == "km" else decimal(text)


def _of_finding(finding: Finding) -> str:
    values = dict(finding.values)
    if finding.kind == LIST:
        return gettext(values["separator"]).join(map(spoken, values["parts"]))
    if finding.kind in _NAMING and (sensor := _SENSOR.fullmatch(values["name"])):
        values["name"] = _of_sensor(sensor)
    forms = TEMPLATES[finding.kind]
    template = ngettext(*forms, values["n"]) if len(forms) == 2 else gettext(forms[0])
    return _Spoken().vformat(template, (), values)
