"""Packages of extras, which may be missing: errors state the command that installs them.

It installs from suspnet's own folder: no package index has suspnet.
"""

from __future__ import annotations

import importlib
import importlib.util
from typing import Any

from suspnet.ground.findings import Finding


def import_extra(module: str, extra: str, user: str, error: type[Exception] = ValueError) -> Any:
    """Return a module of an extra that `user` needs; `error` if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        raise error(
            Finding("needs-module", user=user, module=module, command=install_command(extra))
        ) from missing


def check_extra(extra: str, *modules: str) -> None:
    """Raise ValueError unless modules of an extra are installed; none of them is imported."""
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(f"{', '.join(missing)} is missing: {install_command(extra)}")


def install_command(extra: str) -> str:
    """Return the command that installs an extra, and where to run it."""
    return f'pip install ".[{extra}]" in the folder of suspnet'
