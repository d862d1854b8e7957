"""What loggers write about a trip: lines above a table, properties of a file, columns of a table.

Names are English or German. A line is a name, a sign (``: = ;``, a tab or a comma) and a value,
such as ``Kilometerstand;123.456,7 km``. Each key is one of a manifest.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from suspnet.trains.recordings.dates import read_date, short_lines

NAMES: Mapping[str, tuple[str, ...]] = {
    "mileage_km": (
        *("mileage", "odometer", "kilometerstand", "km stand", "kmstand"),
        *("laufleistung", "laufleistung km", "kilometerleistung"),
    ),
    "start": ("start", "date", "datum", "beginn", "messbeginn", "start time", "startzeit"),
    "vehicle": ("vehicle", "vehicle type", "fahrzeug", "fahrzeugtyp", "baureihe"),
    "train": ("train", "trainset", "zug", "triebzug", "zugnummer"),
    "car": ("car", "wagen", "wagennummer"),
    "suspension": ("suspension", "bogie", "drehgestell", "federung", "aufhängung"),
    "axle": ("axle", "measured axle", "achse", "messachse"),
    "side": ("side", "seite"),
    "direction": ("direction", "direction of travel", "richtung", "fahrtrichtung"),
    "temperature_c": (
        *("temperature", "outside temperature", "ambient temperature"),
        *("air temperature", "temperatur", "außentemperatur", "aussentemperatur"),
    ),
    "wheel_diameter_m": ("wheel diameter", "raddurchmesser"),
    "speed": ("speed", "geschwindigkeit"),
}
"""Names of each key of a manifest, in lower case and with one blank between words."""
GERMAN = frozenset(
    (
        *("kilometerstand", "km stand", "kmstand", "laufleistung", "laufleistung km"),
        *("kilometerleistung", "temperatur", "außentemperatur", "aussentemperatur"),
        *("raddurchmesser", "geschwindigkeit"),
    )
)
"""Names of numbers whose points separate thousands and whose comma is the decimal sign."""
_ENDS = {
    "leading": ("leading", "front", "vorn", "vorne", "vorderes", "vordere", "führend"),
    "trailing": ("trailing", "rear", "hinten", "hinteres", "hintere", "nachlaufend"),
}
WORDS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "bogie": _ENDS,
    "axle": _ENDS,
    "side": {"left": ("left", "links", "li", "l"), "right": ("right", "rechts", "re", "r")},
    "direction": {
        "forward": ("forward", "vorwärts", "vorwaerts", "vor", "1", "+1"),
        "reverse": ("reverse", "backward", "rückwärts", "rueckwaerts", "rück", "-1"),
    },
}
"""Words for each value of the keys with a choice."""
NUMBERS = ("mileage_km", "temperature_c", "wheel_diameter_m")
"""Keys whose values are numbers."""
_LINE = re.compile(r"[\W_]*(?P<name>[^:=;\t,]{2,40}?)[\"'\s]*[:=;\t,]+(?P<rest>.+)")
_NUMBER = re.compile(r"[-+]?\d[\d.,' ]*")
_BRACKETS = re.compile(r"[\[(]([^\[\]()]*)[\])]")
_SPEED = re.compile(r"(\d+(?:[.,]\d+)?) *(km/h|m/s)")


@dataclass(frozen=True)
class Stated:
    """Value of a key of a manifest, and where it is from."""

    value: str | float
    source: str


def stated_in(lines: Iterable[str]) -> dict[str, Stated]:
    """Return what lines state, by the keys of a manifest; the first line of a key counts.

    >>> stated = stated_in(["Kilometerstand;123.456,7 km", "Fahrzeug: am96", "Drehgestell;vorn"])
    >>> {key: note.value for key, note in stated.items()}
    {'mileage_km': 123456.7, 'vehicle': 'am96', 'bogie': 'leading'}
    """
    stated: dict[str, Stated] = {}
    for line in short_lines(lines):
        match = _LINE.match(line)
        key = key_of(match["name"]) if match else ""
        if match is None or not key:
            continue
        value = read_value(key, match["name"], " ".join(re.split(r"[;\t\"]+", match["rest"])))
        if value is not None:
            name, content = value
            source = f"by the line {match['name'].strip()!r}"
            stated.setdefault(name, Stated(content, source))
    return stated


def key_of(name: str) -> str:
    """Return the key of a manifest that a name means; empty if it is none.

    >>> key_of("Kilometerstand [km]"), key_of("Messstelle")
    ('mileage_km', '')
    """
    plain = _plain(name)
    return next((key for key, names in NAMES.items() if plain in (_plain(key), *names)), "")


def read_value(
    key: str, name: str, text: str, is_german: bool = False
) -> tuple[str, str | float] | None:
    """Return the key and the value of a text; None if it is not one of that key.

    `name` decides how a number is written, unless `is_german`, and may hold the unit of a speed in
    brackets. "suspension" with the word for a leading or trailing bogie is "bogie". `start` is in
    ISO format.

    >>> read_value("speed", "Geschwindigkeit [km/h]", "252,5"), read_value("speed", "v", "252,5")
    (('speed', '252.5 km/h'), None)
    """
    text = " ".join(text.split()).strip("\"', ")
    if not text:
        return None
    if key == "suspension" and (bogie := choice_of("bogie", text)):
        return "bogie", bogie
    if key in WORDS:
        chosen = choice_of(key, text)
        return (key, chosen) if chosen else None
    if key == "start":
        moment = read_date(text)
        return None if moment is None else (key, moment.isoformat())
    if key == "speed":
        match = _SPEED.match(" ".join([text, *_BRACKETS.findall(name)]))
        return None if match is None else (key, f"{match[1].replace(',', '.')} {match[2]}")
    if key in NUMBERS:
        number = _number(text, is_german or _plain(name) in GERMAN)
        if number is not None and key == "wheel_diameter_m" and number > 10:  # in mm
            number /= 1000
        return None if number is None else (key, number)
    return key, text


def choice_of(key: str, text: str) -> str:
    """Return the value of a key with a choice that the words of a text mean; empty if unclear."""
    words = set(re.split(r"[^\w+-]+", text.lower()))
    values = [value for value, names in WORDS[key].items() if words & {value, *names}]
    return values[0] if len(values) == 1 else ""


def _plain(name: str) -> str:
    bare = _BRACKETS.sub(" ", name)
    return " ".join(re.split(r"[^\w]+|_", bare.lower())).strip()


def _number(text: str, is_german: bool) -> float | None:
    match = _NUMBER.search(text)
    if match is None:
        return None
    digits = match[0].replace(" ", "").replace("'", "").rstrip(".,")
    if "," in digits and "." in digits:
        decimal = max(",.", key=digits.rfind)
    elif re.fullmatch(r"[-+]?\d{1,3}([.,]\d{3})+", digits):  # 123.456 is German for 123456
        decimal = "," if is_german else "."
    else:
        decimal = "," if "," in digits else "."
    other = "." if decimal == "," else ","
    try:
        return float(digits.replace(other, "").replace(decimal, "."))
    except ValueError:
        return None
