"""Words of the command line as typed: a path keeps its name whatever Hydra's grammar makes of it.

The grammar reads ``trips=a,b`` as two values, ``trips=417_003`` as a number, and refuses umlauts.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.types import Quote, QuotedString

from suspnet.ground.core_yaml import parse_yaml

LISTS = ("run", "engineers")
"""Keys of one text or a list of texts, ``[A,B]``."""
MAPPINGS = ("n_healthy",)
"""Keys of a number or a mapping from names of folders; the program reads the mapping as text."""
PATHS = (
    *("healthy", "journal", "notify", "out", "resume", "store", "suspensions"),
    *("token_file", "trips", "source.folder"),
    *(f"source.broker.{key}_file" for key in ("ca", "cert", "key")),
)
"""Keys of one path. In the files of configurations their unit is ``path``."""
FOLDERS_OF_HYDRA = ("hydra.run.dir", "hydra.sweep.dir")
"""Keys of paths that may hold interpolations."""
WITH_VALUE = ("--config-dir", "-cd", "--config-path", "-cp", "--config-name", "-cn", "--package")
"""Options of Hydra whose next word is their value."""
WORD = re.compile(r"(\+{0,2}([\w.]+)=)(.*)", re.ASCII | re.DOTALL)
PLAIN = re.compile(r"(?!(?:true|false|null|nan|inf)$)[a-z/][\w/.-]*|null", re.ASCII | re.IGNORECASE)
"""Text that the grammar takes as it is, and null."""
CALL = re.compile(r"(choice|range|shuffle|sort|tag)\(.*\)")
"""A sweep that the grammar computes."""
TEXT_IN_QUOTES = r"'(?:\\.|[^'\\])*'|\"(?:\\.|[^\"\\])*\""
QUOTED = re.compile(TEXT_IN_QUOTES, re.DOTALL)
ITEM = re.compile(rf"\s*({TEXT_IN_QUOTES}|\[.*?\](?=,|$)|[^,]*?)\s*(?:,|$)", re.DOTALL)


def as_overrides(words: Sequence[str]) -> list[str]:
    r"""Return the words of a command line with what Hydra would not read as typed in quotes.

    A file or a folder that has exactly the name typed is meant by it. Otherwise a multirun reads
    commas between paths as the grammar does, and a list of runs its brackets; text in quotes and
    null stay as they are.

    >>> as_overrides(["trips=Züge, neu", "store=4711", "run=[a,it's]", "seed=1", "resume=null"])
    ["trips='Züge, neu'", "store='4711'", "run=[a,'it\\'s']", 'seed=1', 'resume=null']
    >>> as_overrides(["-m", "trips=Züge,trips/b"])
    ['-m', "trips='Züge',trips/b"]
    """
    is_multirun = bool({"-m", "--multirun"} & set(words))
    return [
        word if before in WITH_VALUE else _override(word, is_multirun)
        for before, word in zip(["", *words], words, strict=False)
    ]


def listed(paths: Sequence[object]) -> str:
    """Return one path, or a list of several, as the value of a key."""
    texts = [str(path) for path in paths]
    needs_quotes = re.compile(r"[][,'\"\\]|^\s|\s$")
    items = [quoted(text) if needs_quotes.search(text) else text for text in texts]
    return texts[0] if len(texts) == 1 else f"[{','.join(items)}]"


def quoted(text: str, *, is_literal: bool = True) -> str:
    """Return a text in quotes, in which `is_literal` leaves no interpolation."""
    return QuotedString(
        text.replace("${", r"\${") if is_literal else text, Quote.single
    ).with_quotes()


def of_each_name(text: str) -> dict[str, Any]:
    """Return the names and the values of ``{NAME:VALUE,...}``; a value may be any YAML.

    >>> of_each_name("{Züge: 5, 417_003:null}")
    {'Züge': 5, '417_003': None}
    """
    pairs = (item.rpartition(":") for item in _items(text[1:-1]))
    return {name.strip(" '\""): parse_yaml(value) for name, _, value in pairs}


def _override(word: str, is_multirun: bool) -> str:
    parts = WORD.fullmatch(word)
    if parts is None:
        return word
    start, key, value = parts.groups()
    if key in MAPPINGS:
        is_mapping = value.startswith("{") and value.endswith("}")
        return start + quoted(value) if is_mapping else word
    if key not in (*PATHS, *LISTS, *FOLDERS_OF_HYDRA):
        return word
    if is_multirun and key not in FOLDERS_OF_HYDRA and not os.path.lexists(value):
        if CALL.fullmatch(value):
            return word
        return start + ",".join(_value(item, key) for item in _items(value))
    return start + _value(value, key)


def _value(text: str, key: str) -> str:
    """Return one value of a key as the grammar takes it."""
    if not os.path.lexists(text):
        if QUOTED.fullmatch(text):
            return text
        if key in LISTS and text.startswith("[") and text.endswith("]"):
            return f"[{','.join(_value(item, '') for item in _items(text[1:-1]))}]"
    if PLAIN.fullmatch(text):
        return text
    return quoted(text, is_literal=key not in FOLDERS_OF_HYDRA)


def _items(text: str) -> list[str]:
    """Return the items between commas, except commas in quotes or brackets."""
    return [item[1] for item in ITEM.finditer(text) if item[1]]
