"""Stiffness and damping of train suspensions from three vertical accelerometers.

The public names are imported when they are first used, so that ``import suspnet`` is quick. They
are those of `__init__.pyi`, where type checkers find them too.
"""

import importlib
import re
from pathlib import Path
from typing import Any

from suspnet._version import __version__ as __version__

_STUB = Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")
_HOMES = {
    name: home for home, name in re.findall(r"^from (\S+) import ([A-Za-z]\w*) as", _STUB, re.M)
}
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'suspnet' has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return [*_HOMES, "__version__"]
