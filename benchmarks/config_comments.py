"""The comments in configs/, from the sentences that settings are declared with."""

import functools
import re
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args, get_origin

import yaml

from suspnet.cli.commission_fleet import HealthySettings
from suspnet.cli.config_files import CONFIGS, TABLES
from suspnet.cli.kinds import KINDS, class_of
from suspnet.cli.serve import ServeSettings
from suspnet.curves.components import CurveFeatures
from suspnet.curves.extraction import PeakFeatures
from suspnet.depot.live.replay import Replay
from suspnet.ground.core_yaml import LOADER
from suspnet.ground.settings import Declared, settings_of
from suspnet.trains.simulation.fleet import Trains
from suspnet.trains.simulation.signals import Sensor

COLUMNS = 100
"""Longest line of the files."""
Keys = tuple[str, ...]
"""A key, after those that lead to it."""
MERGE = "tag:yaml.org,2002:merge"
BEHIND = re.compile(r"\s#\s*(.*)$")


@dataclass(frozen=True)
class Comments:
    """Comments of a file, by the keys that lead to each key.

    `above` holds the sentence on a key, `behind` the comment behind its value, `kinds` the `kind`
    directly below it, `names` the outermost keys and `lines` the line and the column of each key,
    from 0. Items of a list have the keys of the list. What an alias or a merged mapping repeats is
    left out. `is_global`: the keys are those of a whole configuration, not of the file's group.
    """

    above: dict[Keys, str]
    behind: dict[Keys, str]
    kinds: dict[Keys, str]
    names: list[str]
    lines: dict[Keys, tuple[int, int]]
    is_global: bool


@functools.cache
def read_comments(file: Path) -> Comments:
    r"""Return the comments of a file.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     file = Path(folder) / "trip.yaml"
    ...     _ = file.write_text("# A trip\n\n# Its length\n# [min]\nminutes: 20 # usable\n")
    ...     phrase(file), read_comments(file).above, read_comments(file).behind
    ('A trip', {('minutes',): 'Its length [min]'}, {('minutes',): 'usable'})
    """
    text = file.read_text(encoding="utf-8", errors="replace")
    lines = text.splitlines()
    comments = Comments({}, {}, {}, [], {}, text.startswith("# @package _global_\n"))
    for keys, value, mark in _keys(yaml.compose(text, Loader=LOADER)):
        comments.lines[keys] = (mark.line, mark.column)
        if above := _above(lines, mark.line, mark.column):
            comments.above[keys] = above
        if behind := BEHIND.search(lines[mark.line]):
            comments.behind[keys] = behind[1]
        if keys[-1] == "kind":
            comments.kinds[keys[:-1]] = str(value.value)
        if len(keys) == 1:
            comments.names.append(keys[0])
    return comments


def _above(lines: Sequence[str], number: int, column: int) -> str:
    """Return the comment right above a key on one line; "" if that is the file's first comment."""
    first = number
    while first > 0 and lines[first - 1].startswith(" " * column + "#"):  # ends at the first line
        first -= 1
    return "" if first == 0 else " ".join(text.strip(" #") for text in lines[first:number])


def _keys(root: yaml.Node | None) -> Iterator[tuple[Keys, yaml.Node, yaml.Mark]]:
    """Yield each key of a document, after those that lead to it, with its value and position.

    They come in the order of the document, so an anchor comes before its aliases.
    """
    stack: list[tuple[Keys, Any]] = [((), root)]
    seen: set[int] = set()
    while stack:  # each node is taken off once
        keys, node = stack.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        below: list[tuple[Keys, Any]] = []
        if isinstance(node, yaml.SequenceNode):
            below = [(keys, item) for item in node.value]
        elif isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                if key.tag != MERGE and isinstance(key, yaml.ScalarNode):
                    name = (*keys, str(key.value))
                    yield name, value, key.start_mark
                    below.append((name, value))
        stack += reversed(below)


OF_PROGRAMS: dict[str, list[Declared]] = {
    "replay": [*settings_of(Replay).values()],
    "simulate": [*settings_of(Trains).values()],
    "serve": [*settings_of(ServeSettings).values()],
    "train": [*settings_of(HealthySettings).values()],
}
"""Settings of programs that are no object's."""


NUMBERS = {2: "two numbers", 3: "three numbers", 4: "four numbers"}
"""Name of a list of numbers by its length."""


def text(declared: Declared) -> str:
    """Return the description of a setting, followed by unit and range in brackets."""
    return f"{declared.setting.sentence} [{rule(declared)}]"


def rule(declared: Declared) -> str:
    """Return unit and range of a setting."""
    setting, choices = declared.setting, declared.choices
    if setting.rule:
        return setting.rule + "; or null" * (declared.is_optional and setting.rule != "null")
    several = (
        NUMBERS.get(len(get_args(declared.type)), "") if get_origin(declared.type) is tuple else ""
    )
    kind = "whole number" if declared.type is int else several
    words = [
        ", ".join(filter(None, [kind, setting.unit])),
        "true or false" * (declared.type is bool),
        " or ".join(filter(None, [", ".join(map(str, choices[:-1])), *choices[-1:]])),
        bounds(declared),
        "or null" * declared.is_optional,
    ]
    return "; ".join(filter(None, words))


def bounds(declared: Declared) -> str:
    """Return the range of a setting."""
    setting = declared.setting
    high = setting.most if setting.high is None else setting.high
    if setting.low is not None and high is not None:
        return f"{short(setting.low)} to {short(high)}"
    ends = {
        "above": setting.above,
        "at least": setting.low,
        "below": setting.below,
        "at most": high,
    }
    return " and ".join(f"{name} {short(end)}" for name, end in ends.items() if end is not None)


def short(number: float) -> str:
    """Return a bound as text; round values from 1e4 on as powers of ten."""
    power = f"{number:.0e}".replace("e+0", "e").replace("e+", "e")
    if abs(number) >= 1e4 and float(power) == number:
        return power
    return f"{number:.15g}"


def declaring() -> Iterator[tuple[str, str, Keys, Any]]:
    """Yield place, kind, path and class of everything that declares settings."""
    for place, kinds in KINDS.items():
        for kind in kinds:
            if place != "generator" or kind == "vertical_vehicle":  # the others hand theirs on
                yield place, kind, (), class_of(place, kind)
    yield "protocol", "", ("features",), PeakFeatures
    yield "protocol", "", ("curve",), CurveFeatures
    yield "fleet", "", ("sensors", "axle_box"), Sensor


def declared() -> dict[tuple[str, str, Keys], str]:
    """Return the sentence on each setting, by place, kind and key of its object."""
    return {
        (place, kind, (*path, name)): text(one)
        for place, kind, path, class_ in declaring()
        for name, one in settings_of(class_).items()
    }


def commented(file: Path) -> str:
    """Return the text of a file in configs/, with the declared sentences above their keys.

    A key without a comment, whose sentence another file has, remains so.
    """
    sentences, comments = declared(), read_comments(file)
    programs = OF_PROGRAMS if file.parent == Path(CONFIGS) else {}
    of_program = {(one.name,): text(one) for one in programs.get(file.stem, ())}
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    for keys in reversed(comments.above):  # from the last line on, so that numbers of lines hold
        known = [sentences[one] for one in objects_of(file, keys) if one in sentences]
        sentence = known[-1] if known else of_program.get(keys)
        if sentence is not None:
            end, column = comments.lines[keys]
            start = end
            while lines[start - 1].startswith(" " * column + "#"):
                start -= 1
            lines[start:end] = [f"{line}\n" for line in wrapped(sentence, " " * column + "# ")]
    return "".join(lines)


def objects_of(file: Path, keys: Keys) -> Iterator[tuple[str, Any, Keys]]:
    """Yield each object that a key of a file belongs to: its place, its kind, the key below it."""
    comments, tables = read_comments(file), {name: group for group, (name, _) in TABLES.items()}
    folder = file.parent.name
    group = file.stem if folder == "base" else tables.get(file.name, folder)
    # an entry of a table has a name, after which come the keys
    before = () if comments.is_global else (group,)
    path = (*before, *keys[file.name in tables :])
    for n, place in enumerate(path[:-1]):
        if place in KINDS:
            kind = comments.kinds.get(path[len(before) : n + 1], "")
            yield place, kind, path[n + 1 :]


def wrapped(sentence: str, indent: str) -> list[str]:
    """Return a sentence as lines; unit and range get a line of their own rather than break."""
    whole = filled(sentence, indent)
    meaning, _, rule = sentence.rpartition(" [")
    if f"[{rule}" in whole[-1]:
        return whole
    return filled(meaning, indent) + filled(f"[{rule}", indent)


def filled(words: str, indent: str) -> list[str]:
    """Return words as lines of at most `COLUMNS` characters, each after an indent."""
    return textwrap.wrap(
        words,
        COLUMNS,
        initial_indent=indent,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
    )
