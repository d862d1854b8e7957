"""HTML pages: templates of the packages, and how they write numbers, symbols and words."""

import math
import re
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from suspnet.ground.parameters import (
    BOGIE_PARTS,
    KIND_NAMES,
    NAMES,
    UNITS,
    Severity,
    condensed,
    kind_of,
    part_words,
    place_words,
)
from suspnet.ground.storage import write_atomically
from suspnet.ground.wording import NO_NUMBER, number, thousands, unbroken
from suspnet.runs.language import N_, current, decimal, gettext, ngettext, spoken
from suspnet.trains.maintenance.judge import ABSURD
from suspnet.trains.maintenance.life import Life

SEVERITIES = {
    Severity.ACT: ("act", N_("Act")),
    Severity.NOTICE: ("notice", N_("Notice")),
    Severity.UNKNOWN: ("plain", N_("Not judged")),
    Severity.NONE: ("good", N_("No alarm")),
}
"""Tone and label of each severity; style.css has the colours of each tone."""
LABELS = {str(severity): pair for severity, pair in SEVERITIES.items()}
"""Tone and label of each severity by its name in tables."""
MARKS = {"act": "✕", "notice": "!", "unknown": "?", "none": "✓"}
"""Symbol of each severity, so that colour is not needed."""
KILO = 1e3
KILO_UNITS = {"N/m": "kN/m", "N s/m": "kN s/m", "kg": "t"}  # unit of a thousand of each SI unit
PACKAGE = "suspnet.trains.pages"  # package whose templates all other packages may use
OPTIONS: dict[str, Any] = {
    "extensions": ["jinja2.ext.i18n"],
    "undefined": StrictUndefined,  # an unknown name is an error
    "trim_blocks": True,
    "lstrip_blocks": True,
}
"""Options of every environment of templates."""


@cache
def environment() -> Environment:
    """Return the environment of the templates of this package.

    All pages of a process share it: to compile the templates of a page takes longer than to fill
    them in.
    """
    created = Environment(autoescape=True, loader=FunctionLoader(packaged), **OPTIONS)
    equip(created)
    return created


def equip(environment: Environment) -> None:
    """Give an environment with ``OPTIONS`` the language, filters and globals of all pages."""
    environment.policies["ext.i18n.trimmed"] = True
    environment.install_gettext_callables(  # type: ignore[attr-defined]
        gettext, ngettext, newstyle=True
    )
    environment.filters |= FILTERS
    environment.globals |= GLOBALS


def render(template: str, **values: Any) -> str:
    """Return an HTML template, filled in."""
    return environment().get_template(template).render(**values)


def write_page(path: Path, template: str, **values: Any) -> Path:
    """Write a page of this package's template atomically; return its path."""
    page = render(template, **values)
    return write_atomically(path, page.encode("utf-8", errors="replace"))


def packaged(name: str, *packages: str) -> str | None:
    """Return a file's text from the first package that has it, or this one; None if none does."""
    for package in (*packages, PACKAGE):
        file = resources.files(package).joinpath(name)
        if file.is_file():
            return file.read_text(encoding="utf-8")
    return None


def level(ratio: float | None, digits: int) -> str:
    """Return a ratio to healthy in %, without the number if it is above any real suspension's."""
    if ratio is not None and ratio > ABSURD:
        return gettext("over %s") % f"{100 * ABSURD:.0f}"
    return shown_number(ratio, digits, 100)


def shown_number(value: float | None, digits: int = 1, scale: float = 1.0) -> str:
    """Return a number with the decimal sign of the current language, or a dash."""
    return decimal(number(value, digits, scale))


def _plus_minus(half_width: float, digits: int) -> Markup:
    """Return a half width in small print; empty if there is none."""
    if not math.isfinite(half_width):
        return Markup()
    return Markup("<small> ± {}</small>").format(shown_number(half_width, digits))


def _si(value: float, name: str) -> Markup:
    """Return a parameter's value with its unit in small print; empty if there is none."""
    if not math.isfinite(value):
        return Markup()
    return Markup("<small>{}</small>").format(with_unit(f"{value / KILO:.4g}", name))


def with_unit(number: str, name: str) -> str:
    """Return a number with the unit, a thousand of a parameter's SI unit."""
    unit = KILO_UNITS[UNITS[name]].replace(" ", "\N{NO-BREAK SPACE}")
    return f"{decimal(number)}\N{NO-BREAK SPACE}{unit}"


def _to_go(life: Life | None, unknown: str = "") -> Markup:
    """Return the distance to the act limit, with the 80 % interval in small print.

    It is a dash without limits, and "unknown" with the reason if that is given.
    """
    if life is not None and life.interval_km()[1] == 0:
        return Markup(gettext("passed"))
    if unknown:
        return Markup("{}<small>{}</small>").format(gettext("unknown"), spoken(unknown))
    if life is None:
        return Markup(NO_NUMBER)
    low, high = life.interval_km()
    if not math.isfinite(low):
        return Markup(gettext("no end in sight"))
    ends = [_rounded(km) for km in (life.quantile_km(0.5), low, high)]
    return Markup("{}<small>{}</small>").format(ends[0], _range_of(*ends[1:]))


def _rounded(km: float) -> str:
    return unbroken(thousands(float(f"{km:.2g}"))) if math.isfinite(km) else gettext("no end")


def symbol(name: str) -> Markup:
    """Return the symbol of a parameter; of anything else, as of a sensor, its name in words."""
    if name not in UNITS:
        return Markup.escape(spoken(name))
    letter, _, index = kind_of(name).partition("_")
    words = Markup("<i>{}</i><sub>{}</sub>").format(letter, index)
    if name not in BOGIE_PARTS:
        return words
    return Markup('{} <span class="place">{}</span>').format(words, spoken(place_words(name)))


def typeset(text: str) -> Markup:
    """Return a text with its symbols, such as k_p, as a letter with an index."""
    letters = r"(?<![\w.=])([kchM\N{GREEK SMALL LETTER RHO}])_([a-z\d])(?!\w)"
    return Markup(re.sub(letters, r"<i>\1</i><sub>\2</sub>", str(Markup.escape(text))))


def named(name: str) -> str:
    """Return what a parameter is, and a part as a depot calls it; other names as given."""
    return spoken(part_words(name) if name in BOGIE_PARTS else KIND_NAMES.get(name, name))


def _range(pair: tuple[float, float]) -> str:
    return _range_of(*(decimal(f"{100 * end:g}") for end in pair))


def _range_of(low: str, high: str) -> str:
    return gettext("%(low)s to %(high)s") % {"low": low, "high": high}


GLOBALS = {"labels": LABELS, "marks": MARKS, "language": current}
FILTERS = {
    "columns": lambda names: [Markup("#{}\n[%]").format(symbol(name)) for name in names],
    "condensed": condensed,
    "level": level,
    "number": shown_number,
    "kind_of": kind_of,
    "named": named,
    "part_words": lambda name: spoken(part_words(name)),
    "plus_minus": _plus_minus,
    "thousands": lambda value: unbroken(thousands(value)),
    "symbol": symbol,
    "range": _range,
    "si": _si,
    "typeset": typeset,
    "unbroken": unbroken,
    "to_go": _to_go,
    "rounded": _rounded,
    "spoken": spoken,
    "placed": lambda place: spoken(str(place)),
    "described": lambda name: spoken(NAMES.get(name, "sensor")),  # of an alarm
    "translated": gettext,
}
"""Filters of the templates by name."""
