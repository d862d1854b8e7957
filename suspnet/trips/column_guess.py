"""Guesses of what a column is from names, its own and that of its file, in English and German."""

from __future__ import annotations

import re

from suspnet.recordings.manifest import SIDES

SPEED = "speed"
"""What a column may be besides a channel."""

_WORDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    SPEED: (("speed", "veloc", "geschwind", "tempo"), ("v", "vel", "kmh", "kph", "mps", "vzug")),
    "axle_box": (
        ("axle", "achs", "radsatz", "wheelset", "lager", "bearing", "journal"),
        ("box", "ab"),
    ),
    "bogie": (("bogie", "drehgestell", "rahmen", "frame"), ("dg", "truck")),
    "body": (("body", "kasten", "coach", "floor", "boden"), ("car", "wk", "wagen", "cb")),
}
"""For each meaning, parts of words that have it and whole words that have it; the first fit counts:
an axle box is also on a bogie, a bogie also of a car."""
_SIDES = {"left": ("left", "links", "li", "l"), "right": ("right", "rechts", "re", "r")}
_TIMES = ("t", "datetime", "datum", "uhrzeit", "seconds", "sec", "utc")
_TIME_BEGINS = ("time", "zeit")
_OTHER_DIRECTIONS = ("x", "y", "lateral", "longitudinal", "quer", "laengs", "längs", "lat", "long")


def words_of(name: str) -> list[str]:
    """Return the words of a name in small letters, without a unit in brackets at its end.

    >>> words_of("Run1/AxleBoxLeft_2 [m/s2]")
    ['run1', 'axle', 'box', 'left', '2']
    """
    bare = re.sub(r"[\[(][^\[\]()]*[\])]\s*$", "", name)
    spaced = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", bare)
    return [word for word in re.split(r"[\W_]+", spaced.lower()) if word]


def meaning(*names: str) -> str:
    """Return what a column is by the first of some names that says it; empty if none does.

    Returns
    -------
    str
        One of ``CHANNELS``, ``SPEED``, or empty.
    """
    for words in map(words_of, names):
        for what, (parts, wholes) in _WORDS.items():
            if any(word in wholes or any(part in word for part in parts) for word in words):
                return what
    return ""


def is_time(name: str) -> bool:
    """Return whether a column's name says that it holds times."""
    return any(word in _TIMES or word.startswith(_TIME_BEGINS) for word in words_of(name))


def side(*names: str) -> str:
    """Return "left" or "right" by the first of some names that says it; empty if none does."""
    for words in map(words_of, names):
        found = [one for one in SIDES if set(words) & set(_SIDES[one])]
        if len(found) == 1:
            return found[0]
    return ""


def is_of_another_direction(column: str) -> bool:
    """Return whether a column's name says that it is not vertical."""
    return bool(set(words_of(column)) & set(_OTHER_DIRECTIONS))
