"""Packages of extras, which may be missing: errors state the command that installs them."""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any


def import_extra(module: str, extra: str, user: str, error: type[Exception] = ValueError) -> Any:
    """Return a module of an extra that `user` needs; `error` if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        raise error(f'{user} needs {module}; run: pip install "suspnet[{extra}]"') from missing


def check_extra(extra: str, *modules: str) -> None:
    """Raise ValueError unless modules of an extra are installed; none of them is imported."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(f'{", ".join(missing)} is missing: pip install "suspnet[{extra}]"')
