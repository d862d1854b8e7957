"""What the comments of a configuration file say of its keys, and of itself.

The comment lines right above a key, at its indentation, are a sentence on the key, which ends with
its unit and range in brackets: ``# Length of a trip [min; above 0]``. The first comment of a file
is on the file; a comment behind a value is on the value.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

Keys = tuple[str, ...]
"""A key with those that lead to it."""
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
MERGE = "tag:yaml.org,2002:merge"
NO_WORDS = re.compile(r"@package |python |suspnet-\w+ ")
"""Begin of lines of a file's first comment that are for Hydra, or commands."""
BEHIND = re.compile(r"\s#\s*(.*)$")


@dataclass(frozen=True)
class Comments:
    """Comments of a file by the keys that lead to what they stand at.

    A list's keys are those of its items. What an alias or a merged mapping repeats is left out.

    Attributes
    ----------
    above, behind : mapping
        From keys to the sentence on them, and to the comment on their value.
    kinds : mapping
        From keys to the `kind` right below them.
    names : list of str
        The outermost keys.
    """

    above: dict[Keys, str]
    behind: dict[Keys, str]
    kinds: dict[Keys, str]
    names: list[str]


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
    found = Comments({}, {}, {}, [])
    for keys, value, mark in _keys(yaml.compose(text, Loader=LOADER)):
        if above := _above(lines, mark.line, mark.column):
            found.above[keys] = above
        if behind := BEHIND.search(lines[mark.line]):
            found.behind[keys] = behind[1]
        if keys[-1] == "kind":
            found.kinds[keys[:-1]] = str(value.value)
        if len(keys) == 1:
            found.names.append(keys[0])
    return found


def phrase(file: Path) -> str:
    """Return the first line of the first comment of a file; "" if it has none."""
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.lstrip("# ")
        if not line.startswith("#"):
            break
        if words and not NO_WORDS.match(words):
            return words.rstrip(".")
    return ""


def _above(lines: Sequence[str], line: int, column: int) -> str:
    """Return the comment right above a key on one line; "" if that is the file's first comment."""
    first = line
    while first > 0 and lines[first - 1].startswith(" " * column + "#"):  # ends at the first line
        first -= 1
    return "" if first == 0 else " ".join(one.strip(" #") for one in lines[first:line])


def _keys(root: yaml.Node | None) -> Iterator[tuple[Keys, yaml.Node, yaml.Mark]]:
    """Yield each key of a document, after those that lead to it, its value and its place.

    In the order of the document: what an alias stands for comes before it.
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
