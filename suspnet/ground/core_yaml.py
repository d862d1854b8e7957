"""YAML by the core schema of YAML 1.2, without duplicate keys and of bounded depth and size.

YAML 1.1, which PyYAML follows, reads ``no`` as false, ``12:30:45`` as 45045 and ``0777`` as 511.
Here these are the texts "no" and "12:30:45" and the number 777.
"""

import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import yaml

from suspnet.ground.storage import read_plain

DEEPEST = 20  # largest depth of nested lists and mappings
LONGEST = 2**20  # largest number of characters
MOST_BYTES = 4 * LONGEST  # largest number of bytes
MOST_VALUES = 2**18
"""Largest number of values, counting each repetition by an alias: nested lists of aliases grow
exponentially when a message writes them out."""
_NULL = ("", "~", "null", "Null", "NULL")
_BOOLEANS = {
    word: value
    for value, words in ((True, ("true", "True", "TRUE")), (False, ("false", "False", "FALSE")))
    for word in words
}
_INTEGER = re.compile(r"[-+]?[0-9]{1,4000}")
_BASED = re.compile(r"0o[0-7]{1,1000}|0x[0-9a-fA-F]{1,1000}")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_SPECIAL = re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class TooLargeError(ValueError):
    """A document has more than ``LONGEST`` characters or ``MOST_VALUES`` values."""


class _Dumper(yaml.SafeDumper):
    """Quotes text that YAML 1.1 or the core schema would read as another type."""


def _text(dumper: yaml.SafeDumper, value: str) -> yaml.ScalarNode:
    """Return the node of a text; characters that some readers take for a line end are escaped."""
    style = '"' if re.search("[\x85\u2028\u2029\ufeff]", value) else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", value, style=style)


_Dumper.add_representer(str, _text)
for _pattern in (_BASED, _FLOAT):
    _Dumper.add_implicit_resolver(
        "tag:yaml.org,2002:float", re.compile(rf"^(?:{_pattern.pattern})$"), list("-+.0123456789")
    )


def parse_yaml(text: str, names: Collection[str] = ()) -> Any:
    """Return the content of a YAML document: mappings, lists, text, numbers, booleans, None.

    A number is text as it is written if its key is one of `names`: ``suspension: 0471``. Aliases
    and merge keys (``<<``) are followed. ValueError, with a message of one line that names the line
    of the document, if it is not YAML, holds a duplicate key, a tag or a second document, or
    exceeds ``DEEPEST``, ``LONGEST`` or ``MOST_VALUES``.
    """
    if len(text) > LONGEST:
        raise TooLargeError(f"it has {len(text)} characters; at most {LONGEST} are read")
    try:
        return _Builder(names).document(yaml.parse(text, Loader=LOADER))
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from error


def read_yaml(path: Path) -> Any:
    """Return the content of a plain file as `parse_yaml` does, with the same errors.

    NotPlainError, a ValueError, if it is not a plain file or is too large.
    """
    return parse_yaml(read_plain(path, MOST_BYTES).decode("utf-8-sig"))


def dump_yaml(content: Any) -> str:
    """Return YAML that `parse_yaml` and any YAML 1.1 reader read back unchanged."""
    return str(
        yaml.dump(
            content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, default_flow_style=None
        )
    )


class _Builder:
    def __init__(self, names: Collection[str]) -> None:
        self.names = names
        self.anchors: dict[str, Any] = {}
        self.sizes: dict[str, int] = {}
        self.n_values = 0

    def document(self, events: Iterator[Any]) -> Any:
        """Return the content of the only document."""
        content, n_documents = None, 0
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                n_documents += 1
                if n_documents > 1:
                    raise ValueError(f"line {_line(event)}: a second document begins")
                content = self._node(next(events), events, 0)
        return content

    def _node(self, event: Any, events: Iterator[Any], depth: int) -> Any:
        if depth > DEEPEST:
            raise ValueError(f"line {_line(event)}: it is nested more than {DEEPEST} deep")
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self.anchors:
                raise ValueError(f"line {_line(event)}: the alias {event.anchor!r} is unknown")
            self._count(event, self.sizes[event.anchor])
            return self.anchors[event.anchor]
        before = self.n_values
        self._count(event, 1)
        if event.tag not in (None, "!", "tag:yaml.org,2002:str"):
            raise ValueError(f"line {_line(event)}: tags are not allowed, got {event.tag!r}")
        content: Any
        if isinstance(event, yaml.ScalarEvent):
            content = _scalar(event)
        elif isinstance(event, yaml.SequenceStartEvent):
            content = []
            for item in events:  # ends with the sequence, or with the parser's error
                if isinstance(item, yaml.SequenceEndEvent):
                    break
                content.append(self._node(item, events, depth + 1))
        else:
            content = self._mapping(events, depth)
        if event.anchor is not None:
            self.anchors[event.anchor] = content
            self.sizes[event.anchor] = self.n_values - before
        return content

    def _count(self, event: Any, n_values: int) -> None:
        """Count values; TooLargeError if there are too many."""
        self.n_values += n_values
        if self.n_values > MOST_VALUES:
            raise TooLargeError(f"line {_line(event)}: it has more than {MOST_VALUES} values")

    def _mapping(self, events: Iterator[Any], depth: int) -> dict[Any, Any]:
        """Return a mapping; ValueError if it holds a duplicate key."""
        content: dict[Any, Any] = {}
        merged: list[Any] = []
        lines: dict[Any, int] = {}
        for event in events:
            if isinstance(event, yaml.MappingEndEvent):
                break
            key, line = self._node(event, events, depth + 1), _line(event)
            if isinstance(key, dict | list):
                raise ValueError(f"line {line}: a key must be text, not a list or mapping")
            if key in lines:
                raise ValueError(
                    f"line {line}: the key {key!r} is given twice, first in line {lines[key]}"
                )
            lines[key] = line
            content_event = next(events)
            value = self._node(content_event, events, depth + 1)
            if key in self.names and type(value) in (int, float):
                value = str(getattr(content_event, "value", value))
            if key == "<<" and event.implicit[0]:
                merged += value if isinstance(value, list) else [value]
                if not all(isinstance(mapping, dict) for mapping in merged):
                    raise ValueError(f"line {line}: `<<` must be followed by mappings")
            else:
                content[key] = value
        for mapping in merged:  # the mapping's own keys and earlier merges take precedence
            content = mapping | content
        return content


def _scalar(event: yaml.ScalarEvent) -> Any:
    """Return the value of a scalar by the core schema; quoted scalars are text."""
    text = str(event.value)
    if not event.implicit[0]:
        return text
    if text in _NULL:
        return None
    if text in _BOOLEANS:
        return _BOOLEANS[text]
    if _INTEGER.fullmatch(text):
        return int(text)
    if _BASED.fullmatch(text):
        return int(text, 0)
    if _FLOAT.fullmatch(text):
        return float(text)
    return float(text.replace(".", "", 1)) if _SPECIAL.fullmatch(text) else text


def _line(event: Any) -> int:
    """Return the line in which an event starts, counted from 1."""
    return int(event.start_mark.line) + 1
