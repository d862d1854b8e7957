"""Contents of data files: what loggers note about a trip, and columns by their first samples.

Names are English or German. A line of notes is a name, a sign (``: = ;``, a tab or a comma) and a
value, such as ``Kilometerstand;123.456,7 km``. Each key is one of a manifest.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from suspnet.ground.parameters import SIDES
from suspnet.ground.types import FloatArray
from suspnet.trains.recordings.columns import Column, OpenFile, size_of, unit_in_name
from suspnet.trains.recordings.dates import read_date, short_lines
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_file, read_columns
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_sources import TIME_UNITS

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
NUMBERS = ("mileage_km", "temperature_c", "wheel_diameter_m")  # keys whose values are numbers
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


ACCELERATION, SPEED = "acceleration", "speed"
MILEAGE = "mileage_km"  # the key of a manifest that a column may state
MOST_COLUMNS = 500  # largest number of columns of a file that are inspected
MOSTLY_RISING = 0.99  # least share of rising steps in a column of times
_WORDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    SPEED: (("speed", "veloc", "geschwind", "tempo"), ("v", "vel", "kmh", "kph", "mps", "vzug")),
    "axle_box": (
        ("axle", "achs", "radsatz", "wheelset", "lager", "bearing", "journal"),
        ("box", "ab", "al"),
    ),
    "bogie": (("bogie", "drehgestell", "rahmen", "frame"), ("dg", "truck")),
    "body": (("body", "kasten", "coach", "floor", "boden"), ("car", "wk", "wagen", "cb")),
}
"""For each meaning, parts of words and whole words that have it. The first match counts: an axle
box is also on a bogie, and a bogie also belongs to a car."""
_TIMES = ("t", "datetime", "datum", "uhrzeit", "seconds", "sec", "utc")
_TIME_BEGINS = ("time", "zeit")
_OTHER_DIRECTIONS = ("x", "y", "lateral", "longitudinal", "quer", "laengs", "längs", "lat", "long")


def words_of(name: str) -> list[str]:
    """Return the words of a name in lower case, without a unit in brackets at its end.

    >>> words_of("Run1/AxleBoxLeft_2 [m/s2]")
    ['run1', 'axle', 'box', 'left', '2']
    """
    bare = re.sub(r"[\[(][^\[\]()]*[\])]\s*$", "", name)
    spaced = re.sub(r"(?<=[a-zäöüß])(?=[A-Z])", " ", bare)
    return [word for word in re.split(r"[\W_]+", spaced.lower()) if word]


def guessed_meaning(*names: str) -> str:
    """Return one of ``CHANNELS`` or ``SPEED`` by the first name that shows it; empty if none."""
    for words in map(words_of, names):
        for meaning, (parts, wholes) in _WORDS.items():
            if any(word in wholes or any(part in word for part in parts) for word in words):
                return meaning
    return ""


def names_times(name: str) -> bool:
    """Return whether a column's name is one of times."""
    return any(word in _TIMES or word.startswith(_TIME_BEGINS) for word in words_of(name))


def guessed_side(*names: str) -> str:
    """Return "left" or "right" by the first name that states a side; empty if none does."""
    for words in map(words_of, names):
        sides = [side for side in SIDES if set(words) & set(WORDS["side"][side])]
        if len(sides) == 1:
            return sides[0]
    return ""


def is_of_another_direction(column: str) -> bool:
    """Return whether a column's name states a direction other than vertical."""
    return bool(set(words_of(column)) & set(_OTHER_DIRECTIONS))


Address = tuple[Path, str]  # file and name of a column


@dataclass(frozen=True)
class Signal:
    """One column of numbers, and what is known about it.

    `unit` is as the file or the column's name writes it. `rate_hz` is stated by the file or
    computed from its times; NaN if unknown. `time` is the column of its times, empty if it has none
    or the file states the rate, and `time_unit` their unit if only their column's name states it.
    `names` serve to guess its meaning: its own, with and without its group's, and that of a file
    with at most two columns or with columns that name no channel. `first` is the first sample.
    `axle` is 1 or 2 of the bogie where the user stated it, else 0; `range` is NaN unless stated.
    """

    file: Path
    column: Column
    unit: str
    rate_hz: float
    time: str = ""
    time_unit: str = ""
    names: tuple[str, ...] = ()
    first: float = np.nan
    axle: int = 0
    range: float = np.nan

    @property
    def name(self) -> str:
        """Name of the column."""
        return self.column.name

    @property
    def address(self) -> Address:
        """File and column: loggers of one kind give their columns the same names."""
        return self.file, self.name

    @property
    def meaning(self) -> str:
        """Channel or speed, by names and unit; empty if these do not show it."""
        if key_of(self.name) == MILEAGE:
            return ""
        guess = guessed_meaning(*self.names)
        if size_of(SPEED, self.unit) is not None:
            return SPEED
        is_acceleration = size_of(ACCELERATION, self.unit) is not None
        return "" if guess == SPEED and is_acceleration else guess

    @property
    def side(self) -> str:
        """Side of the vehicle, by names; empty if these do not show it."""
        return guessed_side(*self.names)


@dataclass(frozen=True)
class Contents:
    """Columns of numbers of a file, how it is read if that was detected, and its logger's notes."""

    file: Path
    signals: tuple[Signal, ...]
    read_as: str = ""
    notes: tuple[str, ...] = ()


def contents_of(file: Path) -> Contents:
    """Return the columns of numbers of a file, without times, and what else it states.

    TripError is raised if the file cannot be read, or holds no column of numbers.
    """
    with open_file(file) as opened:
        columns = opened.columns[:MOST_COLUMNS]
        # times first: other columns take their rate from them
        names = [column.name for column in columns if column.is_time or names_times(column.name)]
        times = {name: values for name in names if len(values := _times(file, opened, name)) > 1}
        others = [c for c in columns if not (c.is_time or c.unread or c.name in times)]
        inspected = [_signal(file, opened, column, times) for column in others]
        refused = "; ".join(f"{c.name!r} {c.unread}" for c in columns if c.unread)
    signals = [signal for signal in inspected if signal is not None]
    if not signals:
        raise TripError(f"{file} holds no column of numbers{': ' if refused else ''}{refused}")
    has_channels = bool({signal.meaning for signal in signals} & set(CHANNELS))
    if len(signals) <= len(SIDES) or not has_channels:
        signals = [_named_by_its_file(signal) for signal in signals]
    words = [opened.words, f"{file.name}: not read: {refused}" if refused else ""]
    return Contents(file, tuple(signals), "; ".join(filter(None, words)), opened.notes)


def _named_by_its_file(signal: Signal) -> Signal:
    sizes = (size_of(kind, signal.unit) for kind in (ACCELERATION, SPEED))
    if signal.unit and all(size is None for size in sizes):  # such as a temperature
        return signal
    return replace(signal, names=(*signal.names, signal.file.stem))


def _first(file: Path, opened: OpenFile, name: str) -> FloatArray:
    try:
        return next(iter(read_columns(file, opened, [name])))[0]
    except TripError:
        return np.empty(0)


def _times(file: Path, opened: OpenFile, name: str) -> FloatArray:
    """Return the first times of a column, [s] or its own unit; empty if they do not increase.

    Some may be missing, and a clock may start again.
    """
    block = _first(file, opened, name)
    if block.dtype.kind == "M":
        block = block[~np.isnat(block)]
        block = np.asarray((block - block[0]) / np.timedelta64(1, "s") if len(block) else [])
    block = block[np.isfinite(block)]
    is_rising = len(block) > 1 and (np.diff(block) > 0).mean() >= MOSTLY_RISING
    return np.asarray(block, dtype=np.float64) if is_rising else np.empty(0)


def _signal(
    file: Path, opened: OpenFile, column: Column, times: dict[str, FloatArray]
) -> Signal | None:
    values = _first(file, opened, column.name)
    if values.dtype.kind != "f" or len(values) < 1 + (key_of(column.name) != MILEAGE):
        return None
    # the rate is the file's, else that of the column's own or the first shared times
    time, time_unit, rate_hz = "", "", column.rate_hz
    if rate_hz is None:
        time = column.time or next(iter(times), "")
        rate_hz, time_unit = _rate(opened, time, times[time]) if time in times else (np.nan, "")
    finite = values[np.isfinite(values)]
    return Signal(
        file=file,
        column=column,
        unit=column.unit or unit_in_name(column.name),
        rate_hz=rate_hz,
        time=time,
        time_unit=time_unit,
        names=(column.name.rpartition("/")[2], column.name),
        first=float(finite[0]) if len(finite) else np.nan,
    )


def _rate(opened: OpenFile, time: str, times: FloatArray) -> tuple[float, str]:
    """Return the rate of some times [Hz], and their unit if only the column's name states it."""
    column = opened.column(time)
    stated = "" if column.is_time else column.unit or unit_in_name(time)
    words = [word for word in words_of(time)[1:] if word in TIME_UNITS]
    named = words[-1] if words and not stated and not column.is_time else ""
    step = float(np.median(np.diff(times))) * (size_of("time", stated or named) or 1.0)
    return 1 / step, named
