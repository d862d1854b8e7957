"""A thread that updates the state of a fleet, and reports when it cannot."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime

from suspnet.report.board import Board

log = logging.getLogger(__name__)


class Refresher:
    """Updates a board in its own thread; `every_s` [s] is the pause between two refreshes."""

    def __init__(self, board: Board, every_s: float) -> None:
        self.board = board
        self.every_s = every_s
        self._error = ""
        self._started_at: datetime | None = None
        self._looked: datetime | None = None
        self._read: datetime | None = None
        self._wake, self._end = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="refresher", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def soon(self) -> None:
        """Refresh now instead of after the usual pause."""
        self._wake.set()

    def stop(self, wait_s: float = 5.0) -> None:
        """Stop the thread, and wait for it up to `wait_s` [s]."""
        self._end.set()
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(wait_s)

    @property
    def fault(self) -> str:
        """Why the pages may be out of date; empty if they are not."""
        if not self._thread.is_alive():
            why = f" ({self._error})" if self._error else ""
            return f"The history is no longer read{why}: start suspnet-serve again."
        view = self.board.view
        if self._error:
            return f"The state of the fleet could not be computed: {self._error}."
        return f"The store cannot be read: {view.trouble}." if view.trouble else ""

    @property
    def read_at(self) -> datetime:
        """When the store was last read: the time of the data on the pages."""
        return self._read or self.board.view.at

    @property
    def words(self) -> str:
        """When the store was last read, as text."""
        if self._started_at:
            since = f", since {clock(self._started_at)}"
            return f"reading changes{since}"
        return f"last read at {clock(self._looked)}" if self._looked else "not read yet"

    def _run(self) -> None:
        """Refresh until stopped; after an error, try again."""
        try:
            while not self._end.is_set():
                self._wake.clear()
                self._look(self.board.refresh)
                self._wake.wait(self.every_s)
        except BaseException as error:
            self._error = f"{type(error).__name__}: {error}"
            raise

    def _look(self, refresh: Callable[[], bool]) -> None:
        started = self._started_at = datetime.now(UTC)
        try:
            refresh()
            self._error = ""
            self._looked = datetime.now(UTC)
            if not self.board.view.trouble:
                self._read = started
        except Exception as error:
            if not self._error:
                log.exception("the state of the fleet could not be computed")
            self._error = f"{type(error).__name__}: {error}"
        finally:
            self._started_at = None


def clock(time: datetime) -> str:
    """Return a time by this computer's clock, with its day unless it is today."""
    local = time.astimezone()
    is_today = local.date() == datetime.now().astimezone().date()
    return f"{local:%H:%M:%S}" if is_today else f"{local:%Y-%m-%d %H:%M:%S}"
