"""Packages of extras, which may be missing: errors state the command that installs them.

It installs from suspnet's own folder: no package index has suspnet.
"""

import importlib
import importlib.util
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from suspnet.ground.findings import Finding

PACKAGES = {
    "trips": ("jinja2", "pyarrow", "sqlalchemy"),
    "live": ("flask", "flask_wtf", "waitress", "werkzeug"),
}
"""What the extras of trips and of the depot install, and their modules import at once."""


@contextmanager
def optional(extra: str) -> Iterator[None]:
    """Leave out the imports of a ``with`` block if packages of an extra are missing.

    What uses them calls `check_extra` first.
    """
    try:
        yield
    except ModuleNotFoundError as missing:
        if package_of(missing) not in PACKAGES[extra]:
            raise


@contextmanager
def named_extras(extra: str | None = None) -> Iterator[None]:
    """Raise ValueError, with the command that installs it, where a package of an extra is missing.

    The extra is `extra` if that is given, which includes the others, or that of the package.
    """
    try:
        yield
    except ModuleNotFoundError as missing:
        if words := missing_words(missing, extra):
            raise ValueError(words) from missing
        raise


def missing_words(error: BaseException | None, extra: str | None = None) -> str:
    """Return which package of an extra an error is about, and what installs it; empty if none."""
    while error is not None:  # ends: a cause is older than its error
        package = package_of(error) if isinstance(error, ModuleNotFoundError) else ""
        for name, packages in PACKAGES.items():
            if package in packages:
                return f"{package} is missing: {install_command(extra or name)}"
        error = error.__cause__
    return ""


def package_of(missing: ModuleNotFoundError) -> str:
    """Return the package that an import did not find."""
    return (missing.name or "").partition(".")[0]


def import_extra(module: str, extra: str, user: str, error: type[Exception] = ValueError) -> Any:
    """Return a module of an extra that `user` needs; `error` if it is not installed."""
    try:
        return importlib.import_module(module)
    except ImportError as missing:
        raise error(
            Finding("needs-module", user=user, module=module, command=install_command(extra))
        ) from missing


def check_extra(extra: str, *modules: str) -> None:
    """Raise ValueError unless modules of an extra are installed; none of them is imported.

    Without `modules` they are those of ``PACKAGES``.
    """
    named = modules or PACKAGES[extra]
    missing = [name for name in named if importlib.util.find_spec(name) is None]
    if missing:
        raise ValueError(f"{', '.join(missing)} is missing: {install_command(extra)}")


def install_command(extra: str) -> str:
    """Return the command that installs an extra, and where to run it."""
    return f'pip install -e ".[{extra}]" in the folder of suspnet'
