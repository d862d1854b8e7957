"""What is found of a trip, a suspension, a part or a sensor: a kind and its values.

Programs pass a ``Finding`` on, store it and give it to others as data. Its text stands in
findings.txt, one kind a line: ``kind: template``, or ``kind: singular | plural`` of the value `n`.
Pages, mails and reports fill in the template in their language (``report.language.spoken``);
everything else that prints a finding has its English text, as a ``Finding`` is that text too.
"""

import functools
import json
import string
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import resources
from types import MappingProxyType
from typing import IO, Any, Self, TypeGuard

LIST, OF = "list", "of"
WORN, WORN_ONE_OF, WITHOUT_SENSORS = "worn-part", "worn-one-of", "without-sensors"
"""Kinds that programs look for: several findings in a row, a finding with its subject in front, a
worn part, several parts of which one is worn, and parts that were read without some sensors."""


def _lines(text: str) -> Iterator[tuple[int, str, tuple[str, ...]]]:
    """Yield number, kind and forms of each template; that of a plain name is empty."""
    for number, line in enumerate(text.splitlines(), 1):
        if line and not line.startswith("#"):
            kind, _, template = line.partition(": " if line[0] != "=" else " ")
            yield number, kind.strip("="), tuple(template.replace(r"\n", "\n").split(" | "))


def extract(
    file: IO[bytes], *_: Any, **__: Any
) -> Iterator[tuple[int, str | None, Any, list[str]]]:
    """Yield line and text of each template, for ``pybabel extract``."""
    for number, _kind, forms in _lines(file.read().decode()):
        yield number, "ngettext" if forms[1:] else None, forms if forms[1:] else forms[0], []


_TEXT = resources.files("suspnet.ground").joinpath("findings.txt").read_text("utf-8")
TEMPLATES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {kind: forms for _, kind, forms in _lines(_TEXT)}
)
"""The template of each kind, or its singular and plural."""


class Filling(string.Formatter):
    """Fills in a template; the format `km` is that of a mileage."""

    def format_field(self, value: Any, format_spec: str) -> str:
        """Return one value as text."""
        if format_spec == "km":
            return f"{value:,.0f} km".replace(",", " ")
        return str(super().format_field(value, format_spec))


_ENGLISH = Filling()


class Finding(str):
    """A kind with its values, immutable; as text it is its English sentence.

    Parameters
    ----------
    kind : str
        One of ``TEMPLATES``.
    **values : str, int, float, bool, None, Finding or a list of them
        What the template names; numbers of NumPy and anything else are made such.

    Examples
    --------
    >>> found = Finding("missing", words="peaks of the body")
    >>> print(found)
    missing: peaks of the body
    >>> found.kind, dict(found.values)
    ('missing', {'words': 'peaks of the body'})
    """

    kind: str
    values: Mapping[str, Any]

    def __new__(cls, kind: str, /, **values: Any) -> Self:  # noqa: D102 - as the class says
        plain = {name: _simple(value) for name, value in values.items()}
        if kind == LIST:
            text = plain["separator"].join(plain["parts"])
        else:
            singular, *plurals = TEMPLATES[kind]
            form = plurals[0] if plurals and plain["n"] != 1 else singular
            # the class in Python takes ten times as long
            text = _ENGLISH.vformat(form, (), plain) if ":km}" in form else form.format(**plain)
        self = super().__new__(cls, text)
        self.__dict__.update(kind=kind, values=MappingProxyType(plain))
        return self

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"a finding does not change: {name}")

    def __str__(self) -> str:
        return self  # so that an exception with a finding gives it back

    def __reduce__(self) -> tuple[Any, ...]:
        return functools.partial(Finding, self.kind, **self.values), ()

    def plain(self) -> dict[str, Any]:
        """Return kind, values and English text as JSON-able values."""
        plain: dict[str, Any] = _as_plain(self)
        return plain | {"text": str.__str__(self)}


def with_values(text: str, change: Callable[[str], str]) -> str:
    """Return a text, or a finding with its texts changed, such as to one line each."""
    if not isinstance(text, Finding):
        return change(text)

    def changed(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(map(changed, value))
        return with_values(value, change) if isinstance(value, str) else value

    separator = {"separator": text.values["separator"]} if text.kind == LIST else {}
    values = {name: changed(value) for name, value in text.values.items()} | separator
    return Finding(text.kind, **values)


_SIMPLE = (str, float, int, bool, type(None))


def _simple(value: Any) -> Any:
    if isinstance(value, _SIMPLE):
        return value
    if isinstance(value, tuple):
        return tuple(map(_simple, value))
    number = value.item() if hasattr(value, "item") else None  # of NumPy, unless it is a time
    return number if isinstance(number, bool | int | float) else str(value)


def _as_plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_as_plain(item) for item in value]
    if not isinstance(value, Finding):
        return value
    values = {name: _as_plain(item) for name, item in value.values.items()}
    return {"kind": value.kind, "values": values}


def from_plain(value: Mapping[str, Any]) -> str:
    """Return what ``Finding.plain`` wrote; only the text of a kind that is not known any more."""
    try:
        finding = _found(value)
    except (KeyError, ValueError, TypeError, AttributeError, IndexError, RecursionError):
        finding = value.get("text", "")
    return finding if isinstance(finding, str) else ""


def _found(value: Any) -> Any:
    if isinstance(value, list):
        return tuple(map(_found, value))
    if not isinstance(value, dict):
        return value
    return Finding(value["kind"], **{name: _found(item) for name, item in value["values"].items()})


def stored(text: str) -> str:
    """Return a text for one column of a table: a finding as JSON, any other text as it is."""
    return json.dumps(text.plain()) if isinstance(text, Finding) else text


def restored(text: str) -> str:
    """Return what ``stored`` wrote; a text of older versions stays as it is.

    >>> restored(stored(Finding("missing", words="peaks"))).kind, restored("missing: peaks")
    ('missing', 'missing: peaks')
    """
    if not text.startswith('{"kind": '):
        return text
    try:
        return from_plain(json.loads(text))
    except (ValueError, AttributeError, RecursionError):
        return text


def together(parts: Iterable[str], separator: str = "; ") -> str:
    """Return several findings in a row, the empty ones left out; empty if there are none."""
    several: list[str] = []
    for part in filter(None, parts):
        is_alike = kind_is(part, LIST) and part.values["separator"] == separator
        several += parts_of(part) if is_alike else [part]
    if len(several) < 2:
        return several[0] if several else ""
    return Finding(LIST, parts=tuple(several), separator=separator)


def parts_of(text: str) -> tuple[str, ...]:
    """Return the findings that a text was made of; the text itself if it was not."""
    if kind_is(text, LIST):
        return tuple(text.values["parts"])
    return (text,) if text else ()


def kind_is(text: str, kind: str) -> TypeGuard[Finding]:
    """Return whether a text is a finding of a kind."""
    return isinstance(text, Finding) and text.kind == kind


def without(name: object, text: str) -> str:
    """Return a text without the file, trip or sensor that it says itself to be ``of``."""
    if not isinstance(text, Finding):
        return text.removeprefix(f"{name}: ")
    if text.kind == OF and text.values["name"] == str(name):
        return str(text.values["words"])
    where = text.values.get("where")  # of a sensor of this file
    values = {"where": without(name, where)} if where else {}
    return Finding(text.kind, **{**text.values, **values})


def percent(value: float, digits: int) -> Finding:
    """Return a number of percent with its decimals, at most 3."""
    return Finding(f"percent-{digits}", value=value)


def as_plain(text: str) -> list[dict[str, Any]]:
    """Return each finding of a text as ``Finding.plain`` does; one without a kind as its text."""
    return [
        part.plain() if isinstance(part, Finding) else {"kind": "", "values": {}, "text": part}
        for part in parts_of(text)
    ]


def of(name: object, words: str) -> Finding:
    """Return a finding with its file, trip or sensor in front."""
    return Finding(OF, name=str(name), words=words)


def at(name: object, kind: str, /, **values: Any) -> Finding:
    """Return a finding of a kind with its file, trip or sensor in front."""
    return of(name, Finding(kind, **values))
