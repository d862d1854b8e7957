"""Results of evaluated trips: estimates, quality, curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.recordings.manifest import Place

OK, NO_ESTIMATE, ERROR = "ok", "no estimate", "error"
SI_COLUMNS = {
    "k_p": "k_p_n_per_m",
    "c_p": "c_p_ns_per_m",
    "k_s": "k_s_n_per_m",
    "c_s": "c_s_ns_per_m",
    "M_s": "M_s_kg",
}
"""Columns of the parameters in SI units."""


@dataclass(frozen=True)
class Quality:
    """How well a trip's transfer functions are known.

    Attributes
    ----------
    coherence_p, coherence_s : float, [-]
        Mean over the band, axle box - bogie and bogie - body.
    n_averages : float
        Independent averages.
    segments_used, segments_total : int
    duration_s : float, [s]
        Common to all channels.
    usable_percent : float, [%]
        Share of the duration without a fault.
    speed_m_per_s : float, [m/s]
        Mean over the segments used.
    speed_bins : str
        Each bin with its averages.
    features_found : str
    faults : str
        What cleaning found in each channel, the speed and the clocks.
    read_as : str
        How files were read, where that had to be found out, as of CSV files.
    warnings : str
    """

    coherence_p: float = np.nan
    coherence_s: float = np.nan
    n_averages: float = 0.0
    segments_used: int = 0
    segments_total: int = 0
    duration_s: float = np.nan
    usable_percent: float = np.nan
    speed_m_per_s: float = np.nan
    speed_bins: str = ""
    features_found: str = ""
    faults: str = ""
    read_as: str = ""
    warnings: str = ""


@dataclass(frozen=True, eq=False)
class TripCurves:
    """Curves behind one trip's estimate, and an overview of its signals.

    Attributes
    ----------
    frequencies_hz : array of shape (n_freq,), [Hz]
    responses : complex array of shape (2, n_freq), [-]
        G_p and G_s.
    coherences, deviations : arrays of shape (2, n_freq), [-]
        Deviation: standard deviation of the log-magnitude.
    overview_s : array of shape (n_windows,), [s]
        Begin of each window.
    overview_low, overview_high, overview_mean : arrays of shape (3, n_windows), [m/s^2]
        Least, largest and mean value of axle box, bogie and body in each window.
    overview_speed : array of shape (n_windows,), [m/s]
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


@dataclass(frozen=True)
class TripResult:
    """One trip: its estimate, or the reason why there is none.

    Attributes
    ----------
    trip, manifest, vehicle : str
    place : Place
        Which suspension it is of.
    mileage_km : float, [km]
    start : str
        ISO 8601, or empty.
    status : {"ok", "no estimate", "error"}
    reason : str
        Empty if there is an estimate.
    estimates : dict of float, [-]
        Parameters relative to healthy; 1 is healthy.
    raw : dict of float, [-]
        The same relative to the vehicle's nominal parameters.
    truth : dict of float, [-]
        Of simulated trips, relative to the same as `estimates`.
    half_widths : dict of float, [-]
        The interval of an estimate reaches from estimate * exp(-half width) to
        estimate * exp(half width); NaN where the model has no intervals.
    healthy_since_km : float, [km]
        Mileage of the first healthy trip of the commissioning; NaN of a nominal vehicle.
    healthy_si : dict of float, [N/m, N s/m, kg]
        What a ratio of 1 in `raw` means.
    healthy_half_widths : dict of float, [-]
        Half widths of their intervals, in logarithms.
    flags : str
        The flags of the estimate in words; empty if there are none.
    sides : str
        Which side of which part is weaker, in words; empty without pairs of sensors, and if nothing
        stands out.
    quality : Quality
    seconds : float, [s]
        Time the evaluation took.
    temperature_c : float, [°C]
        Of the air outside; NaN where the manifest does not say it.
    curves : TripCurves, optional
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
    raw: dict[str, float] = field(default_factory=dict)
    truth: dict[str, float] = field(default_factory=dict)
    half_widths: dict[str, float] = field(default_factory=dict)
    healthy_since_km: float = np.nan
    healthy_si: dict[str, float] = field(default_factory=dict)
    healthy_half_widths: dict[str, float] = field(default_factory=dict)
    flags: str = ""
    sides: str = ""
    quality: Quality = field(default_factory=Quality)
    seconds: float = 0.0
    temperature_c: float = np.nan
    curves: TripCurves | None = None

    def interval(self, name: str) -> tuple[float, float]:
        """Return lower and upper end of a parameter's interval, [-]; NaN where there is none."""
        value, half = (part.get(name, np.nan) for part in (self.estimates, self.half_widths))
        with np.errstate(over="ignore"):  # nothing is known: from 0 to infinity
            return float(value * np.exp(-half)), float(value * np.exp(half))

    def si(self, name: str) -> tuple[float, float, float]:
        """Return a parameter and the ends of its interval in SI units; NaN where there is none.

        The interval holds the uncertainty of the healthy value too, as independent.
        """
        value = self.raw.get(name, np.nan) * self.healthy_si.get(name, np.nan)
        half = np.hypot(
            self.half_widths.get(name, np.nan), self.healthy_half_widths.get(name, np.nan)
        )
        with np.errstate(over="ignore"):
            return float(value), float(value * np.exp(-half)), float(value * np.exp(half))

    def row(self, outputs: tuple[str, ...]) -> dict[str, Any]:
        """Return the trip as one flat row of a table; the same columns for every trip."""
        head = {
            f: getattr(self, f)
            for f in ("trip", "mileage_km", "start", "status", "reason", "flags", "vehicle")
        } | asdict(self.place)
        numbers = {name: self.estimates.get(name, np.nan) for name in outputs}
        for name in outputs:
            numbers[f"{name}_low"], numbers[f"{name}_high"] = self.interval(name)
        numbers |= {f"{name}_raw": self.raw.get(name, np.nan) for name in outputs}
        numbers |= {f"{name}_truth": self.truth.get(name, np.nan) for name in outputs}
        for name in outputs:
            column = SI_COLUMNS[name]
            ends = (column, f"{column}_low", f"{column}_high")
            numbers |= dict(zip(ends, self.si(name), strict=True))
            numbers[f"{column}_healthy"] = self.healthy_si.get(name, np.nan)
        numbers["healthy_since_km"] = self.healthy_since_km
        numbers["temperature_c"] = self.temperature_c
        return (
            head
            | numbers
            | asdict(self.quality)
            | {"sides": self.sides, "seconds": self.seconds, "manifest": self.manifest}
        )


def relative_to_first(results: list[TripResult], n_first: int) -> list[TripResult]:
    """Return results whose k and c are relative to the median of the vehicle's first trips.

    So is the truth, where it is known. The interval widens by the uncertainty of the median, whose
    variance is pi / 2 times that of a mean of `n_first` trips. That is right for noise; systematic
    errors (of a regression without refinement) cancel only as long as the vehicle does not change.
    The car-body mass stays relative to nominal: pay-load varies from the first trip on. Where fewer
    trips have an estimate, those are taken.
    """
    done = first_trips(results, n_first)
    if not done:
        return results
    names = [name for name in done[0].raw if name != "M_s"]
    estimated = _medians([r.raw for r in done], names)
    true = _medians([r.truth for r in done if set(names) <= set(r.truth)], names)
    reference = {
        name: np.sqrt(np.pi / 2 / len(done)) * np.median([r.half_widths[name] for r in done])
        for name in names
        if all(name in r.half_widths for r in done)
    }
    return [
        replace(
            r,
            estimates=_divided(r.raw, estimated),
            truth=_divided(r.truth, true),
            half_widths={
                k: float(np.hypot(h, reference.get(k, 0.0))) for k, h in r.half_widths.items()
            },
        )
        for r in results
    ]


def relative_truth(result: TripResult, healthy: Sequence[TripResult]) -> TripResult:
    """Return a result whose true k and c are relative to the median of healthy trips', if known."""
    known = [r.truth for r in healthy if r.truth]
    names = [name for name in result.truth if name != "M_s" and all(name in t for t in known)]
    return replace(result, truth=_divided(result.truth, _medians(known, names)))


def first_trips(results: list[TripResult], n_first: int) -> list[TripResult]:
    """Return the `n_first` trips of least mileage that have an estimate, or as many as there are.

    Flagged ones are among them: a vehicle that is unlike the model's is so from the first trip on.
    """
    return sorted((r for r in results if r.status == OK), key=lambda r: r.mileage_km)[:n_first]


def _medians(values: list[dict[str, float]], names: list[str]) -> dict[str, float]:
    """Return the median of each parameter."""
    if not values:
        return {}
    return {name: float(np.median([v[name] for v in values])) for name in names}


def _divided(values: dict[str, float], by: dict[str, float]) -> dict[str, float]:
    """Return values over those of another mapping, 1 where it has none."""
    return {name: value / by.get(name, 1.0) for name, value in values.items()}
