"""Words of the command line as typed: a path keeps its name whatever Hydra's grammar makes of it.

The grammar reads ``trips=a,b`` as two values, ``trips=417_003`` as a number, and refuses umlauts.
"""

import os
import re
from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.types import Quote, QuotedString

from suspnet.ground.core_yaml import parse_yaml

LISTS = ("run", "engineers")  # keys of one text or a list of texts, ``[A,B]``
MAPPINGS = ("n_healthy",)
"""Keys of a number or a mapping from names of folders; the program reads the mapping as text."""
PATHS = (
    *("healthy", "journal", "notify", "out", "resume", "store", "suspensions"),
    *("trips", "source.folder"),
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
QUOTED = re.compile(r"'(?:\\.|[^'\\])*'|\"(?:\\.|[^\"\\])*\"", re.DOTALL)
ENTRY = re.compile(r"\s*(.+?)\s*:\s*([^,:]*?)\s*(?:,|$)")  # a name and its value


def as_overrides(words: Sequence[str]) -> list[str]:
    r"""Return the words of a command line with what Hydra would not read as typed in quotes.

    A file or a folder that has exactly the name typed is meant by it. Otherwise the sweeps of a
    multirun and lists of runs are left to the grammar; text in quotes and null stay as they are.

    >>> as_overrides(["trips=Züge, neu", "store=4711", "run=[a,b]", "seed=1", "resume=null"])
    ["trips='Züge, neu'", "store='4711'", 'run=[a,b]', 'seed=1', 'resume=null']
    """
    is_multirun = bool({"-m", "--multirun"} & set(words))
    return [
        word if before in WITH_VALUE else _override(word, is_multirun)
        for before, word in zip(["", *words], words, strict=False)
    ]


def listed(paths: Sequence[object]) -> str:
    """Return one path, or a list of several, as the value of a key."""
    texts = [str(path) for path in paths]
    items = [text if PLAIN.fullmatch(text) else quoted(text) for text in texts]
    return texts[0] if len(texts) == 1 else f"[{','.join(items)}]"


def quoted(text: str, *, is_literal: bool = True) -> str:
    """Return a text in quotes, in which `is_literal` leaves no interpolation."""
    literal = text.replace("${", r"\${") if is_literal else text
    return QuotedString(literal, Quote.single).with_quotes()


def of_each_name(text: str) -> dict[str, Any]:
    """Return the names and the values of ``{NAME:VALUE,...}``.

    >>> of_each_name("{Züge: 5, 417_003:null}")
    {'Züge': 5, '417_003': None}
    """
    pairs = ENTRY.findall(text[1:-1])
    return {name.strip("'\""): parse_yaml(value) for name, value in pairs}


def _override(word: str, is_multirun: bool) -> str:
    parts = WORD.fullmatch(word)
    if parts is None:
        return word
    start, key, value = parts.groups()
    if key in MAPPINGS:
        is_mapping = value.startswith("{") and value.endswith("}")
        return start + quoted(value) if is_mapping else word
    if key not in (*PATHS, *LISTS, *FOLDERS_OF_HYDRA) or PLAIN.fullmatch(value):
        return word
    # what Hydra's grammar has a meaning for is meant so, unless it is the name of a file
    is_of_hydra = is_multirun or (key in LISTS and value.startswith("[") and value.endswith("]"))
    if (QUOTED.fullmatch(value) or is_of_hydra) and not os.path.lexists(value):
        return word
    return start + quoted(value, is_literal=key not in FOLDERS_OF_HYDRA)
