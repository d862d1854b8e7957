"""Mileage, temperature and standstill of a suspension, by time, from its frames."""

from typing import Any, ClassVar

import numpy as np

from suspnet.ground.records import HIGHEST_KM
from suspnet.trains.recordings.columns import size_of
from suspnet.trains.recordings.dates import SECOND_NS
from suspnet.trains.recordings.frames import Frame, FrameError, end_ns
from suspnet.trains.recordings.manifest import TEMPERATURES_C

STEP_NS = 10 * SECOND_NS
"""Length of the time steps with one stored value each, [ns]: a train runs less than a kilometre in
it."""
MAX_STEPS = 10_000
"""Largest number of stored steps, those of a day. The latest steps are dropped first: they come
from wrong clocks, as sections are at most a day long."""
MAX_SAMPLES = 1000  # largest number of samples used of a frame of mileages or temperatures
STANDSTILL_M_PER_S = 1.0
"""Speed below which a train is at standstill, [m/s]: more than the noise of speed sensors."""


class SlowValues:
    """The last values of mileage and temperature, by time: the first of every ten seconds.

    Frames may arrive in any order, and twice. Between frames the mileage advances by the distance
    that the speed gives. `mileage_km` and `temperature_c` apply until a frame gives a value;
    `passed_km` is the mileage at the end of the last passed section.
    """

    UNITS: ClassVar[dict[str, dict[str, float]]] = {
        "mileage": {"km": 1.0, "m": 1e-3},
        "temperature": {"degC": 1.0, "°C": 1.0},
    }
    """Sensors of slow values, with the factor of each unit."""

    def __init__(self, mileage_km: float, temperature_c: float | None) -> None:
        self.passed_km = mileage_km
        # by sensor and time step: time [ns] and value
        self._values: dict[str, dict[int, tuple[int, float]]] = {"mileage": {}, "temperature": {}}
        self._first_c = temperature_c

    def take(self, frame: Frame) -> None:
        """Store the values of a frame; FrameError if unit or values are invalid."""
        factor = self.UNITS[frame.sensor].get(frame.unit)
        if factor is None:
            units = ", ".join(self.UNITS[frame.sensor])
            raise FrameError("unit", f"{frame.sensor!r} is in {units}, its frame in {frame.unit!r}")
        values = factor * frame.samples.astype(float)
        low, high = (0.0, HIGHEST_KM) if frame.sensor == "mileage" else TEMPERATURES_C
        if values.min() < low or values.max() > high:
            raise FrameError("range", f"{frame.sensor!r} is {low:g} to {high:g}, got {values}")
        stored = self._values[frame.sensor]
        for i, value in enumerate(values[:MAX_SAMPLES].tolist()):
            entry = frame.time_ns + round(i * SECOND_NS / frame.rate_hz), value
            step = entry[0] // STEP_NS
            stored[step] = min(entry, stored.get(step, entry))
        _drop_latest(stored)

    def within(
        self, begin_ns: int, end_ns: int, before_ns: int = 0
    ) -> tuple[float | None, float | None]:
        """Return mileage [km] and temperature [°C] of a section: the first values in it.

        Without a value in the section, the mileage is the last one within `before_ns` before it,
        else None (the mileage at the end of the previous section applies), and the temperature is
        the last one before it.
        """
        mileages, temperatures = (sorted(entries.values()) for entries in self._values.values())
        km = [value for at, value in mileages if begin_ns <= at < end_ns]
        km += [value for at, value in mileages if begin_ns - before_ns <= at < begin_ns][::-1]
        inside = [value for at, value in temperatures if begin_ns <= at < end_ns]
        before = [value for at, value in temperatures if at < begin_ns]
        celsius = next(iter([*inside, *before[::-1]]), self._first_c)
        return (km[0] if km else None), celsius

    def pass_section(self, end_ns: int, mileage_km: float) -> None:
        """Set the mileage at the end of a section, and forget the values within the section."""
        self.passed_km = mileage_km
        before = [entry for entry in self._values["temperature"].values() if entry[0] < end_ns]
        self._first_c = max(before)[1] if before else self._first_c
        for name, entries in self._values.items():
            later = {step: entry for step, entry in entries.items() if entry[0] >= end_ns}
            self._values[name] = later

    def state(self) -> dict[str, Any]:
        """Return JSON-able values for `restore`."""
        values = {name: sorted(entries.values()) for name, entries in self._values.items()}
        return {"passed_km": self.passed_km, "first_c": self._first_c, "known": values}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a state."""
        self.passed_km, self._first_c = state["passed_km"], state["first_c"]
        self._values = {
            name: {at // STEP_NS: (at, value) for at, value in entries}
            for name, entries in state["known"].items()
        }


class Standing:
    """Whether a train moved, for each time step with known speed, in any order of frames."""

    def __init__(self) -> None:
        self._moved: dict[int, bool] = {}

    def take(self, frame: Frame) -> None:
        """Take a frame of the speed."""
        speeds = (size_of("speed", frame.unit) or 1.0) * frame.samples
        has_moved = bool(np.max(speeds) >= STANDSTILL_M_PER_S)
        for step in _steps(frame.time_ns, end_ns(frame)):
            self._moved[step] = has_moved or self._moved.get(step, False)
        _drop_latest(self._moved)

    def stood(self, begin_ns: int, end_ns: int) -> bool:
        """Return whether the speed is known throughout an interval and the train did not move."""
        return not any(self._moved.get(step, True) for step in _steps(begin_ns, end_ns))

    def forget(self, before_ns: int) -> None:
        """Forget the steps before a time."""
        first = before_ns // STEP_NS
        if self._moved and min(self._moved) < first:
            self._moved = {step: moved for step, moved in self._moved.items() if step >= first}

    def state(self) -> list[Any]:
        """Return JSON-able values for `restore`."""
        return sorted(self._moved.items())

    def restore(self, state: list[Any]) -> None:
        """Restore a state."""
        self._moved = dict(state)


def _steps(begin_ns: int, end_ns: int) -> range:
    return range(begin_ns // STEP_NS, -(-end_ns // STEP_NS))


def _drop_latest(by_step: dict[int, Any]) -> None:
    for step in sorted(by_step)[MAX_STEPS:] if len(by_step) > MAX_STEPS else ():
        del by_step[step]
