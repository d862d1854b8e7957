"""Errors of one trip: `TripError`, and how the problems of several checks become one."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from suspnet.ground.findings import Finding, at
from suspnet.ground.storage import NotPlainError


class TripError(ValueError):
    """Something is wrong with one trip: its manifest, or the files that it names.

    Its arguments are the problems, one sentence each; its text shows only the first.
    """

    @classmethod
    def at(cls, where: object, kind: str, /, **values: Any) -> Self:
        """Return an error of one finding, with the file or sensor it is of in front."""
        return cls(at(where, kind, **values))

    @property
    def problems(self) -> tuple[str, ...]:
        """All problems, in the order in which they were found."""
        return tuple(map(str, self.args))

    def __str__(self) -> str:
        more = len(self.args) - 1
        if more < 1:
            return super().__str__()
        return f"{self.args[0]} (and {more} more: suspnet check shows all)"


class DeadSensorError(TripError):
    """A sensor shows nothing: it is constant, or has no usable sample."""

    def __init__(self, where: str, reason: str) -> None:
        super().__init__(Finding("sensor-reason", where=where, reason=reason))
        self.reason = reason

    def __reduce__(self) -> Any:
        values = self.args[0].values
        return type(self), (values["where"], values["reason"])


@contextmanager
def opening(path: Path) -> Iterator[None]:
    """Turn the errors of opening a file that is missing, locked or not plain into TripError."""
    try:
        yield
    except OSError as error:
        raise TripError.at(path, "unreadable-as", reason=error.strerror) from error
    except NotPlainError as error:
        raise TripError(str(error)) from error


def all_of(functions: Iterable[Callable[[], Any]], problems: Iterable[str] = ()) -> list[Any]:
    """Return the results of functions; one TripError with `problems` and those of all functions."""
    results, problems = [], list(problems)
    for function in functions:
        try:
            results.append(function())
        except TripError as error:
            problems += error.problems
    if problems:
        raise TripError(*dict.fromkeys(problems))
    return results
