"""Language of the pages: gettext catalogues of the package, English where no other is chosen."""

from __future__ import annotations

import functools
import gettext as catalogues
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import resources

from jinja2 import Environment

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
    if language == ENGLISH:
        return catalogues.NullTranslations()
    file = resources.files("suspnet.report").joinpath(
        "locale", language, "LC_MESSAGES", f"{DOMAIN}.mo"
    )
    with file.open("rb") as stream:
        return catalogues.GNUTranslations(stream)


def gettext(text: str) -> str:
    """Return a text in the current language, in English if the catalogue lacks it."""
    return catalogue(current()).gettext(text) if text else ""


def ngettext(one: str, many: str, n: int) -> str:
    """Return the singular or the plural of a text for a number, in the current language."""
    return catalogue(current()).ngettext(one, many, n)


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


def install(environment: Environment) -> None:
    """Let templates translate: ``_()``, ``{% trans %}`` and the filter ``translated``.

    The extension jinja2.ext.i18n must be part of the environment.
    """
    environment.policies["ext.i18n.trimmed"] = True
    environment.install_gettext_callables(  # type: ignore[attr-defined]
        gettext, ngettext, newstyle=True
    )


def best_of(accepted: Sequence[str]) -> str:
    """Return the first language that is accepted and known, English if none is.

    `accepted` are tags such as "de-AT", the preferred first.

    >>> best_of(["fr", "de-AT", "en"]), best_of(["fr"])
    ('de', 'en')
    """
    names = (tag.lower().replace("_", "-").partition("-")[0] for tag in accepted)
    return next((name for name in names if name in LANGUAGES), ENGLISH)
