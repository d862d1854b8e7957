"""Stiffness and damping of train suspensions from three vertical accelerometers.

The public names, which `__init__.pyi` lists with their homes, are imported when they are first
used, so that ``import suspnet`` is quick.
"""

import importlib
import pkgutil
import re
from typing import Any

from suspnet._version import __version__ as __version__

_TABLE = (pkgutil.get_data("suspnet", "__init__.pyi") or b"").decode()
_HOMES = {name: home for home, name in re.findall(r"^from (\S+) import (\w+) as", _TABLE, re.M)}
__all__ = sorted(_HOMES.keys() - {"__version__"})


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'suspnet' has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
    return value


def __dir__() -> list[str]:
    return list(_HOMES)
