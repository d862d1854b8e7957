"""A manifest written from data files, with blanks and guesses marked for the user."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from suspnet.ground.parameters import SIDES
from suspnet.ground.wording import command
from suspnet.trains.recordings.clocks import first_moment
from suspnet.trains.recordings.columns import size_of
from suspnet.trains.recordings.logger_notes import Stated
from suspnet.trains.recordings.manifest import CHANNELS, FORMAT
from suspnet.trains.recordings.manifest_sources import ACCELERATION_UNITS, MIDDLE, SPEED_UNITS
from suspnet.trains.trips.file_contents import (
    ACCELERATION,
    SPEED,
    Address,
    Signal,
    guessed_axle,
    is_of_another_direction,
)

BLANK = "FILL_IN"
"""Placeholder of a missing value; suspnet check names each remaining one."""
BY_COMMAND_LINE = "by the command line"
"""Source of a value that KEY=VALUE of the command line states."""
LISTED = 60
"""Largest number of columns that are offered for one channel."""
GRAVITY = {"g": 1.0, "m/s2": ACCELERATION_UNITS["g"]}
"""Gravity in each unit: the mean of a sensor that measures it reveals the sensor's unit."""
HEAD = f"""\
# Manifest of one trip: a template written by suspnet init. Values marked {BLANK} are missing,
# those marked "guess" are taken from names: check both. Then run: """

PLACE_LINES = {
    "vehicle": f"vehicle:          # {BLANK}: as the model's, e.g. am96",
    "suspension": f"suspension:       # {BLANK}: any name; the same in all trips of one suspension",
    "bogie": "# bogie: leading  # or trailing, as it runs forward; without it taken as leading",
    "axle": "# axle: leading   # or trailing: the bogie's axle at which the sensors are",
    "direction": "# direction: forward  # or reverse: with the trailing bogie ahead",
    "side": "",
    "train": "# train: '12'     # where several trains or cars are watched",
    "car": "# car: '7'",
    "mileage_km": f"mileage_km:       # {BLANK}: of the vehicle at this trip",
    "start": "",
    "temperature_c": "# temperature_c: 20.0  # of the air outside",
    "wheel_diameter_m": "# wheel_diameter_m: 0.92  # of the measured wheelset",
}
"""Line of each key of the first part that is not known; those of side and start depend on files."""


@dataclass(frozen=True)
class Template:
    """A manifest to be completed.

    `text` is YAML with comments; `blanks` are keys to be filled in, and `guesses` keys guessed from
    names.
    """

    text: str
    blanks: tuple[str, ...]
    guesses: tuple[str, ...]


def template(
    signals: Sequence[Signal],
    path: Path,
    read_as: Sequence[str] = (),
    known: Mapping[str, Stated] | None = None,
    chosen: Mapping[str, Collection[Address]] | None = None,
    config_dir: Path | None = None,
) -> Template:
    """Return a manifest of the signals of some data files.

    `path` is that of the manifest; data files are named relative to its folder. `read_as` states
    how files are read where that had to be detected, for the first lines. `known` are values of
    keys with where they are from, `chosen` the columns of each channel or of the speed, where these
    were said. `config_dir` is the folder of the user's vehicles, which the next command needs.
    """
    known, chosen = known or {}, chosen or {}
    writer = _Writer(path.parent, tuple(chosen))
    # columns that were chosen count more than those that are guessed by their names
    by_meaning: dict[str, list[Signal]] = {}
    for signal in signals:
        by_meaning.setdefault(signal.meaning, []).append(signal)
    for meaning, addresses in chosen.items():
        by_meaning[meaning] = [signal for signal in signals if signal.address in addresses]
    taken = {address for several in chosen.values() for address in several}
    unknown = [signal for signal in by_meaning.get("", []) if signal.address not in taken]
    lines = [
        HEAD + _on_one_line(_check_command(path, config_dir)),
        *(f"# {_on_one_line(words)}" for words in read_as),
        f"format: {FORMAT}",
    ]
    for key, line in PLACE_LINES.items():
        if key in known:
            lines += [_stated_line(key, known[key])] if known[key].value != MIDDLE else []
        elif key == "side":
            lines += writer.side(by_meaning)
        elif key == "start":
            lines.append(_start(signals))
        else:
            writer.blanks += [key] if BLANK in line else []
            lines.append(line)
    lines.append("")
    if SPEED in known:
        lines.append(_stated_line(SPEED, known[SPEED]))
    else:
        lines += writer.speed(by_meaning.get(SPEED, []), unknown)
    lines += ["", "channels:"]
    for name in CHANNELS:
        lines += writer.channel(name, by_meaning.get(name, []), unknown or signals)
    if unknown:
        more = f" and {len(unknown) - LISTED} more" if len(unknown) > LISTED else ""
        names = ", ".join(_yaml(signal.name) for signal in unknown[:LISTED])
        lines += ["", f"# columns of unknown meaning: {names}{more}"]
    blanks = tuple(dict.fromkeys(writer.blanks))
    return Template("\n".join(lines) + "\n", blanks, tuple(writer.guesses))


def _stated_line(key: str, stated: Stated) -> str:
    return f"{key}: {_yaml(stated.value)}  # {_on_one_line(stated.comment)}"


def _check_command(path: Path, config_dir: Path | None) -> str:
    """Return the command that checks a manifest: where suspnet init ran, or in its folder."""
    if config_dir is not None:
        return command("check", path, "--config-dir", config_dir)
    own = "of a vehicle that is not suspnet's with --config-dir DIR, which holds vehicle/NAME.yaml"
    return f"{command('check', Path(path.name))} ({own})"


def _start(signals: Sequence[Signal]) -> str:
    """Return the line of the start: from the files, or a comment if they do not state it."""
    zeros = [signal.zero for signal in signals]
    moment, doubt = first_moment(zeros)
    if moment is None:
        return f"# start: 2015-08-03T08:00:00  # {doubt or 'when the trip started'}"
    if len({zero.ns is None for zero in zeros}) > 1:  # `start` then applies to the others too
        return f"# start: {moment.isoformat()}  # by some of the files; when do the others start?"
    zone = "" if moment.tzinfo is not None else ", in the logger's zone"
    return f"start: {moment.isoformat()}  # by the files{zone}"


class _Writer:
    def __init__(self, folder: Path, chosen: Sequence[str]) -> None:
        self.folder, self.chosen = folder, chosen
        self.blanks: list[str] = []
        self.guesses: list[str] = []

    def side(self, by_meaning: Mapping[str, Sequence[Signal]]) -> list[str]:
        """Return the line of the side, which single sensors without a side of their own need."""
        several = [by_meaning.get(name, []) for name in CHANNELS]
        if not any(len(own) == 1 and not own[0].side for own in several):
            return ["# side: left      # or right: of the suspension"]
        self.blanks.append("side")
        where = "left or right, where single sensors are; delete the line if in the middle"
        return [f"side:             # {BLANK}: {where}"]

    def speed(self, candidates: Sequence[Signal], others: Sequence[Signal]) -> list[str]:
        """Return the lines of the speed from its candidates by name, or else from other columns."""
        if len(candidates) == 1:
            entry, blanks, words = self._entry(candidates[0], SPEED)
            self.blanks += [f"speed.{key}" for key in blanks]
            return [f"speed: {entry}  # {self._how(SPEED, SPEED)}; {words}"]
        self.blanks.append("speed")
        offers = self._offers(candidates or others, SPEED, "  # ")
        source = "one of these without the #" if offers else "a source like that of a channel"
        words = f"{BLANK}: one number with its unit (252 km/h), or {source}"
        return [f"speed:            # {words}", *offers]

    def channel(
        self, name: str, candidates: Sequence[Signal], others: Sequence[Signal]
    ) -> list[str]:
        """Return the lines of a channel from its candidates by name, or else from other columns."""
        vertical = [s for s in candidates if not is_of_another_direction(s.name)] or candidates
        axles = _axles(vertical) if name != CHANNELS[2] else [1] * len(vertical)
        sides = [[s.side for s, a in zip(vertical, axles, strict=True) if a == at] for at in (1, 2)]
        # one sensor, or a left and a right one, at each axle need no choice
        if vertical and all(len(own) < 2 or sorted(own) == sorted(SIDES) for own in sides):
            lines = [f"  {name}:  # {self._how(name, f'channels.{name}')}"]
            for signal, axle in zip(vertical, axles, strict=True):
                entry, blanks, words = self._entry(signal, ACCELERATION, axle)
                self.blanks += [f"channels.{name}.{key}" for key in blanks]
                lines.append(f"    - {entry}  # {words}")
            rest = [signal for signal in candidates if signal not in vertical]
            return lines + self._offers(rest, ACCELERATION, "    # - ")
        self.blanks.append(f"channels.{name}")
        offers = candidates or others
        words = "take one of these, or a left and a right one, without the #"
        if name != CHANNELS[2]:
            words += "; those of the bogie's other axle get axle: 2"
        return [
            f"  {name}:  # {BLANK}: {words if offers else 'no column of these files is left'}",
            *self._offers(offers, ACCELERATION, "    # - "),
        ]

    def _how(self, what: str, key: str) -> str:
        """Return how columns were found: said, or guessed, which is noted."""
        if what in self.chosen:
            return BY_COMMAND_LINE
        self.guesses.append(key)
        return "guess by the name"

    def _offers(self, signals: Sequence[Signal], kind: str, mark: str) -> list[str]:
        entries = [self._entry(signal, kind) for signal in signals[:LISTED]]
        lines = [f"{mark}{entry}  # {words}" for entry, _, words in entries]
        more = len(signals) - LISTED
        return lines + ([f"    # and {more} more columns"] if more > 0 else [])

    def _entry(self, signal: Signal, kind: str, axle: int = 1) -> tuple[str, list[str], str]:
        """Return a signal in YAML, the keys in it that are blank, and a comment."""
        is_acceleration = kind == ACCELERATION
        is_fraction = is_acceleration and signal.column.full_scale is not None
        content: dict[str, object] = {
            "file": self._relative(signal.file),
            "column": signal.name,
            "side": signal.side if is_acceleration and signal.side else None,
            "axle": axle if axle != 1 else None,
        }
        content["unit"], unit_words = _unit(signal, kind)
        words = [unit_words]
        if signal.time:
            content |= {"time": signal.time, "time_unit": signal.time_unit or None}
            words.append(f"{signal.rate_hz:.6g} Hz by its times")
        elif math.isfinite(signal.rate_hz):
            content["rate_hz"] = float(signal.rate_hz)
            words.append(f"rate {BY_COMMAND_LINE if 'rate_hz' in signal.said else 'by the file'}")
        else:
            content["rate_hz"] = BLANK
            words.append("rate in Hz?")
        if is_fraction or math.isfinite(signal.range):
            content["range"] = signal.range if math.isfinite(signal.range) else BLANK
        if is_fraction:
            words.append("range: what full scale is in that unit, these are fractions of it")
        words.append(f"mean {signal.mean:.3g}, rms about it {signal.deviation:.3g}")
        if is_acceleration and is_of_another_direction(signal.name):
            words.append("vertical?")
        blanks = [key for key, value in content.items() if value is BLANK]
        inside = ", ".join(f"{k}: {_yaml(v)}" for k, v in content.items() if v is not None)
        return f"{{{inside}}}", blanks, _on_one_line("; ".join(words))

    def _relative(self, file: Path) -> str:
        try:
            return Path(os.path.relpath(file, self.folder)).as_posix()
        except ValueError:  # on another drive there is no relative path
            return str(file.resolve())


def _unit(signal: Signal, kind: str) -> tuple[str | None, str]:
    """Return a signal's unit as a manifest writes it, and how it is known or what it may be."""
    allowed = ACCELERATION_UNITS if kind == ACCELERATION else SPEED_UNITS
    size = size_of(kind, signal.unit)
    if size is None:
        stated = f", the file says {signal.unit!r}" if signal.unit else ""
        return BLANK, f"unit {' or '.join(allowed)}?{stated}{_gravity(signal, kind)}"
    names = [name for name, other in allowed.items() if math.isclose(other, size)]
    if signal.column.unit is not None:  # the reader knows it, in whatever way it is written
        return names[0] if names else None, f"unit {signal.unit} by the file"
    how = BY_COMMAND_LINE if "unit" in signal.said else "by the name"
    return names[0] if names else BLANK, f"unit {signal.unit} {how}"


def _axles(signals: Sequence[Signal]) -> list[int]:
    """Return the bogie's axle of each sensor: as said, by names with both and sides, else 1."""
    stated = [signal.axle for signal in signals]
    named = [guessed_axle(*signal.names) for signal in signals if signal.side]
    if not any(stated) and len(named) == len(stated) and set(named) in ({1, 2}, {3, 4}):
        return [2 - number % 2 for number in named]  # without sides they may be left and right
    return [axle or 1 for axle in stated]


def _yaml(value: object) -> str:
    """Return a value in YAML's flow style; text is quoted, except for blanks."""
    if value is BLANK:
        return BLANK
    return json.dumps(value, ensure_ascii=not str(value).isprintable())


def _on_one_line(words: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in words)


def _gravity(signal: Signal, kind: str) -> str:
    """Return the unit of a sensor that also measures gravity; empty if it does not."""
    if kind != ACCELERATION:
        return ""
    for unit, size in GRAVITY.items():
        if abs(abs(signal.mean) / size - 1) < 0.1 > signal.deviation / size / 10:
            return f", a mean of {signal.mean:.2f} is gravity if it is {unit}"
    return ""
