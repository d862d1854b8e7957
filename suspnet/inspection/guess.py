"""Guesses of what a column is from its name and that of its file, in English and German."""

from __future__ import annotations

import re
from pathlib import Path

from suspnet.recordings.manifest import CHANNELS, SIDES

SPEED, TIME = "speed", "time"
"""What a column may be besides a channel."""

_WORDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    SPEED: (
        ("speed", "veloc", "geschwind", "tempo"),
        ("v", "vel", "kmh", "kph", "km/h", "mps", "vzug"),
    ),
    "axle_box": (
        ("axle", "achs", "radsatz", "wheelset", "lager", "bearing", "journal"),
        ("box", "ab", "al", "rs"),
    ),
    "bogie": (("bogie", "drehgestell", "rahmen", "frame", "gestell"), ("dg", "truck")),
    "body": (
        ("body", "kasten", "carbody", "coach", "chassis", "boden", "floor"),
        ("car", "wk", "wagen", "cabin"),
    ),
}
"""For each meaning, parts of words that have it and whole words that have it; the first fit counts:
an axle box is also on a bogie, a bogie also of a car."""
_SIDES = {"left": ("left", "links", "li", "l"), "right": ("right", "rechts", "re", "r")}
_TIMES = ("t", "time", "zeit", "timestamp", "datetime", "datum", "uhrzeit", "seconds", "sec", "utc")
_OTHER_DIRECTIONS = ("x", "y", "lateral", "longitudinal", "quer", "laengs", "längs", "lat", "long")


def words_of(name: str) -> list[str]:
    """Return the words of a name in small letters: those of "ABoxLeft_1 [g]" are abox, left, 1, g.

    >>> words_of("AxleBoxLeft_2 [m/s2]")
    ['axle', 'box', 'left', '2', 'm/s2']
    """
    spaced = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", name)
    return [
        word.strip("./") for word in re.split(r"[^\w./]+|_", spaced.lower()) if word.strip("./")
    ]


def meaning(column: str, file: Path) -> str:
    """Return what a column is by its name, or else by that of its file; empty if neither says it.

    Returns
    -------
    str
        One of ``CHANNELS``, ``SPEED``, ``TIME``, or empty.
    """
    if set(words_of(column)) & set(_TIMES):
        return TIME
    for words in (words_of(column), words_of(file.stem)):
        for what, (parts, wholes) in _WORDS.items():
            if any(word in wholes or any(part in word for part in parts) for word in words):
                return what
    return ""


def side(column: str, file: Path) -> str:
    """Return "left" or "right" by the name of a column, or else of its file; else empty."""
    for words in (words_of(column), words_of(file.stem)):
        found = [one for one in SIDES if set(words) & set(_SIDES[one])]
        if len(found) == 1:
            return found[0]
    return ""


def is_of_another_direction(column: str) -> bool:
    """Return whether a column's name says that it is not vertical."""
    return bool(set(words_of(column)) & set(_OTHER_DIRECTIONS))


def is_channel(what: str) -> bool:
    """Return whether a meaning is one of the three places."""
    return what in CHANNELS
