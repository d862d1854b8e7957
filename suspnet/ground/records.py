"""Records of trips: suspension, estimate or the reason for none, and healthy reference."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, astuple, dataclass, field, fields
from datetime import UTC, datetime
from typing import Any

import numpy as np

from suspnet.ground.findings import Finding, restored, stored, together
from suspnet.ground.parameters import (
    BODY_MASS,
    BOGIE_PARTS,
    COMPONENTS,
    ESTIMATED,
    PARAMETERS,
    SI_COLUMNS,
)
from suspnet.ground.types import BoolArray, ComplexArray, FloatArray

HIGHEST_KM = 2e7
"""Mileage that no rail vehicle reaches, [km]: 40 years of 500 000 km, as fast trains run."""
INTERVAL_LEVEL = 0.9  # probability of the intervals of trips, unless a setting names another one


def interval_ends(values: Any, half_widths: Any) -> tuple[Any, Any]:
    """Return the ends of intervals with half widths in logarithms, 0 and infinity of infinite ones.

    Both arguments are numbers or arrays of the same shape.
    """
    with np.errstate(over="ignore"):
        return values * np.exp(-half_widths), values * np.exp(half_widths)


@dataclass(frozen=True, order=True)
class Place:
    """Location of a suspension; fields are empty if the manifest does not give them.

    `bogie` is one of ``ENDS``, `side` one of ``SIDES``; the others are free text.
    """

    suspension: str = ""
    bogie: str = ""
    side: str = ""
    train: str = ""
    car: str = ""

    def __str__(self) -> str:
        vehicle = [
            self.train and Finding("train", name=self.train),
            self.car and Finding("car", name=self.car),
        ]
        where = [self.bogie and f"{self.bogie} bogie", self.side]
        return together((*vehicle, self.suspension, *where), ", ") or "unknown"


MOST_NAME = 100
"""Largest number of characters of the name of a vehicle, a suspension, a train or a car."""
Key = tuple[str, Place]  # key of a suspension: vehicle and place
OK, NO_ESTIMATE, ERROR = "ok", "no estimate", "error"  # values of ``TripResult.status``


@dataclass(frozen=True)
class SensorHealth:
    """Health of one sensor on a trip; NaN: unknown.

    `noise` [m/s^2/sqrt(Hz)]. `gain`, log of the sensitivity relative to the other sensors, `tilt`,
    how much it rises over the band, and the delay [s] have a meaning only against those of other
    trips. `faulty` is the share of the trip in which samples were lost or repaired.
    """

    noise: float = math.nan
    gain: float = math.nan
    tilt: float = math.nan
    delay_s: float = math.nan
    faulty: float = math.nan


def sensors_text(sensors: Mapping[str, SensorHealth]) -> str:
    """Return the health of a trip's sensors as JSON: {name: [noise, gain, tilt, delay, faulty]}."""
    rows = {
        name: [float(f"{x:.4g}") if math.isfinite(x) else None for x in astuple(health)]
        for name, health in sensors.items()
    }
    return json.dumps(rows, separators=(",", ":")) if rows else ""


def sensors_from_text(text: str) -> dict[str, SensorHealth]:
    """Return the health of sensors from ``sensors_text``; empty if it is not such a text."""
    try:
        rows = json.loads(text) if text else {}
        return {str(name): SensorHealth(*map(or_nan, row)) for name, row in rows.items()}
    except (ValueError, TypeError, AttributeError):
        return {}


@dataclass(frozen=True)
class Quality:
    """Quality of a trip's signals and transfer functions.

    Coherences (axle box - bogie, bogie - body) are means over the band; `misfit` is the rms of the
    residuals over that of the noise, NaN without a fit. `duration_s` is common to all channels,
    `speed_m_per_s` the mean over the segments used, `speed_bins` each bin with its number of
    averages. `direction` is "forward", "reverse" or empty. `faults` are those that cleaning found
    in channels, speed and clocks; `read_as` is how files of a detected format were read; `wheels`
    are out-of-round wheels, or why none can be seen; `sensors` is what ``sensors_text`` writes.
    """

    coherence_p: float = np.nan
    coherence_s: float = np.nan
    misfit: float = np.nan
    n_averages: float = 0.0
    segments_used: int = 0
    segments_total: int = 0
    duration_s: float = np.nan
    usable_percent: float = np.nan
    speed_m_per_s: float = np.nan
    speed_bins: str = ""
    direction: str = ""
    faults: str = ""
    read_as: str = ""
    warnings: str = ""
    wheels: str = ""
    sensors: str = ""


@dataclass(frozen=True, eq=False)
class TripCurves:
    """Curves behind one trip's estimate, and an overview of its signals in windows.

    The shapes are (n_freq,) of `frequencies_hz`; (2, n_freq) of `responses`, G_p and G_s,
    `coherences` and `deviations`, those of log-magnitudes; (n_windows,) of `overview_s`, the start
    of each window, and `overview_speed` [m/s]; (3, n_windows) of minimum, maximum and mean of axle
    box, bogie and body [m/s^2].
    """

    frequencies_hz: FloatArray
    responses: ComplexArray
    coherences: FloatArray
    deviations: FloatArray
    overview_s: FloatArray
    overview_low: FloatArray
    overview_high: FloatArray
    overview_mean: FloatArray
    overview_speed: FloatArray


@dataclass(frozen=True, eq=False)
class Overview:
    """Range and mean of the signals of a recording in windows of equal length.

    `times_s`: (n_windows,), start of each window since the first sample. `low`, `high`, `mean`:
    (3, n_windows), [m/s2], of axle box, bogie and car body. `speed_m_per_s`: (n_windows,), the
    mean; NaN where partly unknown. `faulty`: (n_windows,), whether a sample is unusable; None if
    unknown.
    """

    times_s: FloatArray
    low: FloatArray
    high: FloatArray
    mean: FloatArray
    speed_m_per_s: FloatArray
    faulty: BoolArray | None = None


@dataclass(frozen=True)
class TripResult:
    """One trip: its estimate, or the reason why there is none.

    Attributes
    ----------
    trip, manifest, vehicle, place, mileage_km, start, temperature_c
        As in the manifest; `start` is ISO 8601.
    status : {"ok", "no estimate", "error"}
    reason : str
        Empty if there is an estimate.
    estimates, truth : dict of float, [-]
        Parameters relative to healthy, and those of simulated trips.
    half_widths, healthy_half_widths : dict of float, [-]
        Intervals in logarithms, from estimate * exp(-half width) to estimate * exp(half width), and
        those of the healthy values; NaN if the model has no intervals.
    healthy_since_km : float, [km]
        Mileage of the first healthy trip of the commissioning; NaN for a nominal vehicle.
    healthy_si : dict of float, [N/m, N s/m, kg]
        Value of each parameter at a ratio of 1 in `estimates`.
    flags, worn : str
        Findings: flags of the estimate, and worn parts (``WORN``).
    seconds : float, [s]
        Duration of the evaluation.
    """

    trip: str
    manifest: str
    vehicle: str = ""
    place: Place = field(default_factory=Place)
    mileage_km: float = np.nan
    start: str = ""
    status: str = OK
    reason: str = ""
    estimates: dict[str, float] = field(default_factory=dict)
    truth: dict[str, float] = field(default_factory=dict)
    half_widths: dict[str, float] = field(default_factory=dict)
    healthy_since_km: float = np.nan
    healthy_si: dict[str, float] = field(default_factory=dict)
    healthy_half_widths: dict[str, float] = field(default_factory=dict)
    flags: str = ""
    worn: str = ""
    quality: Quality = field(default_factory=Quality)
    seconds: float = 0.0
    temperature_c: float = np.nan
    curves: TripCurves | None = None

    def interval(self, name: str) -> tuple[float, float]:
        """Return lower and upper end of a parameter's interval, [-]; NaN if there is none."""
        value, half = (part.get(name, np.nan) for part in (self.estimates, self.half_widths))
        low, high = interval_ends(value, half)
        return float(low), float(high)

    def si(self, name: str) -> tuple[float, float, float]:
        """Return a parameter and the ends of its interval in SI units; NaN if there is none.

        The interval includes the uncertainty of the healthy value, assumed independent.
        """
        value = self.estimates.get(name, np.nan) * self.healthy_si.get(name, np.nan)
        half = np.hypot(
            self.half_widths.get(name, np.nan), self.healthy_half_widths.get(name, np.nan)
        )
        low, high = interval_ends(value, half)
        return float(value), float(low), float(high)

    def row(self, outputs: tuple[str, ...]) -> dict[str, Any]:
        """Return the trip as a flat row of a table, with the same columns for every trip."""
        flat = _flat(self)
        flat |= {name: math.nan for name, value in flat.items() if value is None}
        for name in outputs:
            column = SI_COLUMNS[name]
            flat[f"{name}_low"], flat[f"{name}_high"] = self.interval(name)
            flat[column], flat[f"{column}_low"], flat[f"{column}_high"] = self.si(name)
            flat[f"{column}_healthy"] = flat[f"{name}_healthy_si"]
        columns = [
            *("trip", "mileage_km", "start", "status", "reason", "flags", "vehicle"),
            *PLACE,
            *outputs,
            *(f"{name}_{end}" for name in outputs for end in ("low", "high")),
            *(f"{name}_truth" for name in outputs),
            *(
                f"{SI_COLUMNS[n]}{end}"
                for n in outputs
                for end in ("", "_low", "_high", "_healthy")
            ),
            *("healthy_since_km", "temperature_c"),
            *QUALITY_TYPES,
            *("worn", "seconds", "manifest"),
        ]
        return {name: flat[name] for name in columns}


PLACE = tuple(column.name for column in fields(Place))
"""Columns of a suspension's place; empty if unknown."""
PLACE_FROM_TRAIN = ("train", "car", "suspension", "bogie", "side")
"""The same columns from the train down, as in the store and in tables of a fleet."""
SENSOR = "sensor"
"""Kind of maintenance after which the sensors that its text names have a new reference, not the
parts."""
EVENT_KINDS = ("exchanged", "reprofiled", SENSOR, "other")
"""Kinds of maintenance: a part exchanged, wheels reprofiled, a sensor replaced, or other work that
the text names."""
NUMBERS = ("mileage_km", "healthy_since_km", "temperature_c", "seconds")
TEXTS = ("trip", "start", "flags", "status", "reason", "worn", "manifest")
"""Columns of a trip's numbers and texts, named as in ``TripResult``."""
FOUND = ("flags", "reason", "worn")  # those texts that are findings
VALUES = {
    "estimates": "{}",
    "half_widths": "{}_half_width",
    "truth": "{}_truth",
    "healthy_si": "{}_healthy_si",
    "healthy_half_widths": "{}_healthy_half_width",
}
"""Fields of ``TripResult`` with a number for each parameter, and the names of their columns."""
QUALITY_TYPES = {column.name: str(column.type) for column in fields(Quality)}
"""Columns of a trip's quality, with the names of their types."""


def to_row(result: TripResult) -> dict[str, Any]:
    """Return a trip as a flat row for the store and the cache of finished trips.

    Findings are ``stored`` as JSON, missing numbers of a parameter are None. The row does not
    include the curves.
    """
    flat = _flat(result)
    return {
        name: stored(value) if isinstance(value, str) else value for name, value in flat.items()
    }


def _flat(result: TripResult) -> dict[str, Any]:
    row: dict[str, Any] = {"vehicle": result.vehicle} | asdict(result.place)
    row |= {name: getattr(result, name) for name in (*TEXTS, *NUMBERS)}
    for name, column in VALUES.items():
        row |= {
            column.format(parameter): getattr(result, name).get(parameter)
            for parameter in ESTIMATED
        }
    return row | asdict(result.quality)


def from_row(row: Mapping[str, Any]) -> TripResult:
    """Return the trip of a row of ``to_row``; None in other numeric columns becomes NaN."""
    entries: dict[str, Any] = {name: row[name] for name in ("vehicle", *TEXTS)}
    entries |= {name: restored(row[name]) for name in FOUND}
    entries |= {name: or_nan(row[name]) for name in NUMBERS}
    for name, column in VALUES.items():
        values = {parameter: row[column.format(parameter)] for parameter in ESTIMATED}
        entries[name] = {
            parameter: value for parameter, value in values.items() if value is not None
        }
    quality: dict[str, Any] = {
        name: or_nan(row[name]) if kind == "float" else row[name]
        for name, kind in QUALITY_TYPES.items()
    }
    quality |= {name: restored(value) for name, value in quality.items() if isinstance(value, str)}
    place = Place(**{name: row[name] for name in PLACE})
    return TripResult(place=place, quality=Quality(**quality), **entries)


def or_nan(value: float | None) -> float:
    """Return a number of the store, with NaN for NULL."""
    return math.nan if value is None else float(value)


def utc(text: str) -> datetime | None:
    """Return a start without a zone, converted to UTC if it has one; None if it is empty."""
    if not text:
        return None
    try:
        time = datetime.fromisoformat(text)
        return time.astimezone(UTC).replace(tzinfo=None) if time.tzinfo else time
    except (ValueError, OverflowError):
        raise ValueError(f"`start` must be a time in ISO 8601, not {text[:40]!r}") from None


def to_arrays(curves: TripCurves) -> dict[str, FloatArray]:
    """Return curves as real arrays for the store and the cache of finished trips."""
    arrays = {entry.name: getattr(curves, entry.name) for entry in fields(curves)}
    responses = arrays.pop("responses")
    arrays |= {"real": np.real(responses), "imaginary": np.imag(responses)}
    return {name: np.asarray(entry, dtype=float) for name, entry in arrays.items()}


def to_responses(real: FloatArray, imaginary: FloatArray) -> ComplexArray:
    """Return complex responses; `real + 1j * imaginary` would turn infinity into NaN."""
    responses = np.empty(real.shape, dtype=complex)
    responses.real, responses.imag = real, imaginary
    return responses


@dataclass(frozen=True)
class Commissioning:
    """One healthy state of a suspension, to which estimates are relative.

    It starts at `since_km`, [km], with the first of its healthy `trips`; NaN for a nominal vehicle.
    `healthy_si` are its values, [N/m, N s/m, kg], and `relative` [-] these over those of the first
    commissioning.
    """

    since_km: float
    healthy_si: dict[str, float]
    relative: dict[str, float] = field(default_factory=dict)
    trips: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """Text with the healthy values in % of those of the first commissioning."""
        ratios = (
            Finding("ratio", name=name, percent=100 * ratio)
            for name, ratio in self.relative.items()
            if name != BODY_MASS
        )
        return Finding("from-km", km=self.since_km, ratios=together(ratios, ", "))


def outputs_of(results: Iterable[TripResult]) -> tuple[str, ...]:
    """Return what any trip has an estimate of, in the order of tables; the parameters if none."""
    names = {parameter for result in results for parameter in result.estimates}
    if not names & set(BOGIE_PARTS):
        return tuple(parameter for parameter in PARAMETERS if parameter in names) or PARAMETERS
    return tuple(parameter for parameter in (*PARAMETERS[:-1], *COMPONENTS) if parameter in names)


def by_mileage(results: Iterable[TripResult]) -> list[TripResult]:
    """Return trips sorted by mileage and name, those without a mileage last."""
    return sorted(results, key=lambda r: (not math.isfinite(r.mileage_km), r.mileage_km, r.trip))
