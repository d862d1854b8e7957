"""The current state of a fleet, updated from a history, also by a thread."""

import logging
import threading
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

from suspnet.ground.findings import Finding
from suspnet.ground.parameters import DEFAULT_LIMITS, Limits, read_limits
from suspnet.ground.records import Key
from suspnet.trains.history import History, HistoryError
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.maintenance.plan import Plan, PlanSettings, plan_of
from suspnet.trains.maintenance.series import Series
from suspnet.trains.maintenance.state import State, by_urgency, state_of
from suspnet.trains.pages.overview import FleetView

log = logging.getLogger(__name__)
LOOK_S = 1.0  # timeout for a lock of the store by other programs
AT_ONCE = 50  # suspensions that are read and computed at once


@dataclass(frozen=True)
class BoardSettings:
    """Settings of the states and the plan of a fleet.

    `vehicles` has the limits of vehicles by name; others have ``DEFAULT_LIMITS``. `limits` override
    them all. `today` is an ISO 8601 day (None: that of the computer's clock), `seed` that of the
    predicted lives. ValueError is raised if `today` is not a day, or the limits are inconsistent.
    """

    vehicles: Mapping[str, Mapping[str, Limits]] = field(default_factory=dict)
    limits: Mapping[str, Any] | None = None
    changes: ChangeSettings = field(default_factory=ChangeSettings)
    plan: PlanSettings = field(default_factory=PlanSettings)
    today: str | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        try:
            self.day()
        except ValueError:
            raise ValueError(f"`today` must be a day like 2026-03-31, got {self.today!r}") from None
        for vehicle in self.vehicles:
            self.limits_of(vehicle)

    def day(self) -> date:
        """Return the first day of the plan."""
        return date.fromisoformat(str(self.today)) if self.today else date.today()

    def limits_of(self, vehicle: str) -> Mapping[str, Limits]:
        """Return the limits of a vehicle by its name; ValueError if `limits` cannot be read."""
        return read_limits(self.limits or {}, self.vehicles.get(vehicle, DEFAULT_LIMITS))


class Board:
    """The current state of a fleet, updated from a history.

    Only suspensions whose revision in the store changed are read and recomputed; a long refresh
    shows more of them from time to time. Alarms are stored by the evaluation of the trips.

    `store` is the file or URL of the history; a file may be created later. `view` is the last view,
    available at once even while the next one is computed.
    """

    def __init__(self, store: str, settings: BoardSettings) -> None:
        self.store = store
        self.settings = settings
        self._states: dict[Key, State] = {}
        self.view = FleetView()
        self._revisions: dict[Key, int] = {}
        self._plan: Plan | None = None
        self._day = settings.day()
        self._is_due = True
        self._file: tuple[int, int] | None = None
        self._is_doubted = False
        self._lock = threading.Lock()

    def refresh(self) -> bool:
        """Recompute what changed in the store since the last call; return whether the view is new.

        If the store cannot be used the last view stays, with its `trouble`. Concurrent calls of
        threads wait for each other.
        """
        with self._lock:
            before = self.view
            try:
                with History(self.store, wait_s=LOOK_S, must_exist=True) as history:
                    self._refresh(history)
            except HistoryError as error:
                self._is_doubted = True  # it may be another store once it can be read again
                if str(error) != self.view.trouble:
                    log.warning("%s", error)
                    version = self.view.version + 1
                    self.view = replace(self.view, version=version, trouble=str(error))
            return self.view is not before

    def _refresh(self, history: History) -> None:
        revisions, day, file = history.revisions(), self.settings.day(), file_number(self.store)
        self._is_due |= day != self._day
        bad = {row.key for row in self.view.bad_rows}  # they may have been corrected
        is_other = self._is_doubted or file != self._file
        changed = [
            key
            for key, revision in revisions.items()
            if is_other or key in bad or self._revisions.get(key) != revision
        ]
        if changed or self._revisions.keys() - revisions.keys():
            self._read(history, revisions, changed)
        self._file, self._is_doubted = file, False
        if self._is_due:
            states = by_urgency(self._states.values())
            self._plan = plan_of(states, self.settings.plan, day)
            self._show(history, states)
            self._day, self._is_due = day, False
        elif (
            self.view.trouble
            or history.all_acknowledgements() != self.view.acknowledged
            or {*history.bad_rows} != {*self.view.bad_rows}
        ):
            self._show(history, by_urgency(self._states.values()))

    def _read(self, history: History, revisions: dict[Key, int], changed: list[Key]) -> None:
        """Compute the states of suspensions whose trips changed."""
        if self.view.bad_rows or {*changed} - self._revisions.keys():
            history.all_alarms()  # rows of alarms that cannot be read are shown
        self._forget(self._states.keys() - revisions.keys())
        waiting = {*changed}
        due = sorted(waiting, key=lambda key: (key[0], str(key[1])))
        # in parts: an SQLite file cannot be written while it is read
        n_shown = AT_ONCE
        for begin in range(0, len(due), AT_ONCE):
            keys = due[begin : begin + AT_ONCE]
            self._compute(history, keys)
            self._revisions |= {key: revisions[key] for key in keys}
            waiting -= {*keys}
            # each time that twice as many are computed, as a view of all takes long as well
            if waiting and begin + AT_ONCE >= n_shown:
                self._show(history, by_urgency(self._states.values()), waiting)
                n_shown *= 2

    def _compute(self, history: History, keys: Sequence[Key]) -> None:
        series = history.series(keys)
        self._forget({*keys} - {own.key for own in series})
        for own in series:
            before = self._states.get(own.key)
            if before is None or not before.series.equals(own):
                self._states[own.key] = self._state_of(history, own)
                self._is_due = True

    def _state_of(self, history: History, series: Series) -> State:
        settings = self.settings
        try:
            limits = settings.limits_of(series.vehicle)
        except ValueError as error:  # of a vehicle that is not in the settings
            raise HistoryError(f"{history}: vehicle {series.vehicle}: {error}") from None
        return state_of(series, limits, settings.changes, settings.seed)

    def _forget(self, keys: Collection[Key]) -> None:
        self._is_due |= bool(keys)
        for key in keys:
            self._states.pop(key, None)
            self._revisions.pop(key, None)

    def _show(
        self, history: History, states: Sequence[State], waiting: Collection[Key] = ()
    ) -> None:
        """Show states, among which those of `waiting` suspensions are not current."""
        self.view = FleetView(
            version=self.view.version + 1,
            states=tuple(states),
            plan=self._plan,
            acknowledged=history.all_acknowledgements(),
            is_complete=not waiting,
            n_waiting=len(waiting),
            bad_rows=tuple(history.bad_rows),
        )


def file_number(store: str) -> tuple[int, int] | None:
    """Return device and inode, which change if a file is replaced; None for a server."""
    if "://" in store:
        return None
    try:
        status = Path(store).stat()
    except OSError:
        return None
    return status.st_dev, status.st_ino


class Refresher:
    """Updates a board in its own thread; `every_s` [s] is the pause between two refreshes."""

    def __init__(self, board: Board, every_s: float) -> None:
        self.board = board
        self.every_s = every_s
        self._error = ""
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
            kind = "no-longer-read-as" if self._error else "no-longer-read"
            return Finding(kind, error=self._error)
        if self._error:
            return Finding("state-unknown", error=self._error)
        trouble = self.board.view.trouble
        return Finding("store-unreadable", trouble=trouble) if trouble else ""

    @property
    def read_at(self) -> datetime:
        """When the store was last read: the time of the data on the pages."""
        return self._read or self.board.view.at

    @property
    def words(self) -> str:
        """When the store was last read, as text."""
        view = self.board.view  # of the first look, which may take long
        looked = self._looked or (view.at if view.version else None)
        if looked:
            return Finding("last-read", clock=clock(looked))
        return Finding("not-read-yet")

    def _run(self) -> None:
        """Refresh until stopped; after an error, try again."""
        try:
            while not self._end.is_set():
                self._wake.clear()
                self.look()
                self._wake.wait(self.every_s)
        except BaseException as error:
            self._error = f"{type(error).__name__}: {error}"
            raise

    def look(self) -> None:
        """Refresh the board now; an error is logged, and stated by `fault` while there is one."""
        started = datetime.now(UTC)
        try:
            self.board.refresh()
            self._error = ""
            self._looked = datetime.now(UTC)
            if not self.board.view.trouble:
                self._read = started
        except Exception as error:
            if not self._error:
                log.exception("the state of the fleet could not be computed")
            self._error = f"{type(error).__name__}: {error}"


def clock(time: datetime) -> str:
    """Return a time by this computer's clock, with its day unless it is today."""
    local = time.astimezone()
    is_today = local.date() == datetime.now().astimezone().date()
    return f"{local:%H:%M:%S}" if is_today else f"{local:%Y-%m-%d %H:%M:%S}"
