"""Simulated wear histories: the whole path of one parameter until after it has passed its limit.

What they are like, and what no code under suspnet/ knows: lives (mileage from the new part to the
limit "act") are lognormal about ``MEDIAN_LIFE_KM`` with a spread of ``LIFE_SPREAD`` from suspension
to suspension, within ``LIFE_KM``; half of the suspensions begin to wear at once, the others after
up to ``LATEST_ONSET`` of the life; dampers mostly lose damping, springs soften or harden.
Measured values carry noise with the spread of ``NOISE`` and a correlation from trip to trip of 0 to
0.5; the half-widths are right up to ``MISSTATED``.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspnet.ground.parameters import DEFAULT_LIMITS
from suspnet.ground.types import FloatArray

KINDS = ("linear", "exponential", "wiener")
PER_TRAIN = 10
TRIP_KM = 2_000.0
LIFE_KM = (200_000.0, 1_500_000.0)
HISTORY_KM = 1.3 * LIFE_KM[1]
MEDIAN_LIFE_KM = 500_000.0
LIFE_SPREAD = 0.5
LATEST_ONSET = 0.4
NOISE = {"k_p": 0.0008, "c_p": 0.005, "k_s": 0.0008, "c_s": 0.003}
Z90 = 1.645
"""Half-width of a 90 % interval over its standard deviation."""
TRIP_SPREAD = 0.2
"""Spread of the logarithm of the noise from trip to trip, which the half-widths know."""
MISSTATED = 0.15
"""Spread of the logarithm of a factor of each suspension's noise, which they do not know."""
MISSING = 0.02
"""Share of trips without an estimate."""
MAX_DRAWS = 1000


@dataclass(frozen=True)
class WearHistory:
    """One parameter of one suspension, from new until after it has passed its limit.

    Attributes
    ----------
    train, suspension, parameter : str
        Suspensions of one train have their trips at the same mileages.
    kind : str
        "linear", "exponential" (a straight line in the logarithm), "wiener" (a line plus Brownian
        motion) or "healthy"; besides, which are no models of suspnet: "power" (a power 0.6, 0.75,
        1.5 or 2 of the mileage), "bent" (a line whose rate changes once, to 0.4 or 2.5 times) and
        "jumps" (about 30 jumps instead of a line).
    km_per_day : float
    limits : (lower, upper), [-]
    crossing_km : float, [km]
        Mileage at which the true value passes a limit; inf if it never does.
    onset_km : float, [km]
        Mileage at which wear begins.
    mileage_km : array of shape (n_trips,), [km]
        Of all trips, until ``HISTORY_KM``.
    true_values, values, half_widths : arrays of shape (n_trips,), [-]
        Relative to healthy; the half-widths of 90 % intervals in logarithms. NaN: no estimate.
    """

    train: str
    suspension: str
    parameter: str
    kind: str
    km_per_day: float
    limits: tuple[float, float]
    crossing_km: float
    onset_km: float
    mileage_km: FloatArray
    true_values: FloatArray
    values: FloatArray
    half_widths: FloatArray

    def until(self, km: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return mileages, values and half-widths of the trips up to a mileage."""
        n = int(np.searchsorted(self.mileage_km, km, side="right"))
        return self.mileage_km[:n], self.values[:n], self.half_widths[:n]


def make_histories(
    n: int = 300,
    seed: int = 0,
    *,
    kinds: Sequence[str] = KINDS,
    noise: float = 1.0,
    correlation: float | None = None,
) -> list[WearHistory]:
    """Return wear histories, ``PER_TRAIN`` to a train, of all `kinds` in turn.

    Parameters
    ----------
    n, seed : int
    kinds : sequence of str
    noise : float
        Factor of all noise and half-widths.
    correlation : float, optional
        Of the noise from trip to trip; by default drawn from 0 to 0.5 for each suspension.
    """
    histories: list[WearHistory] = []
    for train, rng in enumerate(np.random.default_rng(seed).spawn(-(-n // PER_TRAIN))):
        km_per_day = float(rng.uniform(300, 1000))
        n_trips = int(1.1 * HISTORY_KM / TRIP_KM)
        mileage = np.cumsum(TRIP_KM * rng.gamma(8.0, 1 / 8.0, n_trips))
        mileage = mileage[mileage <= HISTORY_KM]
        for place in range(min(PER_TRAIN, n - len(histories))):
            kind = kinds[len(histories) % len(kinds)]
            parameter = str(rng.choice(list(NOISE)))
            limits = DEFAULT_LIMITS[parameter].act
            onset, crossing, truth = _path(rng, kind, parameter, limits, mileage)
            rho = float(rng.uniform(0, 0.5)) if correlation is None else correlation
            spread = noise * NOISE[parameter] * np.exp(TRIP_SPREAD * rng.normal(size=mileage.size))
            errors = np.exp(MISSTATED * rng.normal()) * spread * _autoregressive(rng, rho, mileage)
            values = truth * np.exp(errors)
            values[rng.random(mileage.size) < MISSING] = np.nan
            histories.append(
                WearHistory(
                    train=f"T{train + 1:02d}",
                    suspension=f"car {place // 4 + 1}, bogie {place // 2 % 2 + 1}, "
                    f"{('left', 'right')[place % 2]}",
                    parameter=parameter,
                    kind=kind,
                    km_per_day=km_per_day,
                    limits=limits,
                    crossing_km=crossing,
                    onset_km=onset,
                    mileage_km=mileage,
                    true_values=truth,
                    values=values,
                    half_widths=np.where(np.isfinite(values), Z90 * spread, np.nan),
                )
            )
    return histories


def _path(
    rng: np.random.Generator,
    kind: str,
    parameter: str,
    limits: tuple[float, float],
    mileage: FloatArray,
) -> tuple[float, float, FloatArray]:
    """Return onset, crossing and true values; crossings are on a grid of 500 km."""
    if kind == "healthy":
        return np.inf, np.inf, np.ones(mileage.size)
    upwards = rng.random() < (0.5 if parameter[0] == "k" else 0.2)
    limit = limits[int(upwards)]
    grid = np.arange(0.0, HISTORY_KM + 500, 500)
    for _ in range(MAX_DRAWS):
        life = MEDIAN_LIFE_KM * np.exp(LIFE_SPREAD * rng.normal())
        onset = life * rng.uniform(0, LATEST_ONSET) if rng.random() < 0.5 else 0.0
        worn = np.clip((grid - onset) / (life - onset), 0, None)
        if kind == "power":
            worn = worn ** float(rng.choice([0.6, 0.75, 1.5, 2.0]))
        elif kind == "bent":
            bend, factor = rng.uniform(0.2, 0.9), rng.choice([0.4, 2.5])
            worn = np.minimum(worn, bend) + factor * np.clip(worn - bend, 0, None)
        elif kind == "jumps":
            worn = np.cumsum(rng.gamma(30 * np.diff(worn, prepend=0.0), 1 / 30))
        elif kind == "wiener":
            # the spread of the life that Brownian motion alone gives, relative to life - onset
            relative = rng.uniform(0.05, 0.3)
            steps = np.sqrt(np.diff(worn, prepend=0.0)) * rng.normal(size=grid.size)
            worn = worn + relative * np.cumsum(steps)
        path = np.exp(worn * np.log(limit)) if kind == "exponential" else 1 + worn * (limit - 1)
        beyond = (path <= limits[0]) | (path >= limits[1])
        crossing = float(grid[beyond.argmax()]) if beyond.any() else np.inf
        if LIFE_KM[0] <= crossing <= LIFE_KM[1]:
            return onset, crossing, np.maximum(np.interp(mileage, grid, path), 0.05)
    raise RuntimeError(f"no crossing within {LIFE_KM} in {MAX_DRAWS} draws")


def _autoregressive(rng: np.random.Generator, rho: float, mileage: FloatArray) -> FloatArray:
    """Return noise of unit variance with correlation `rho` from one trip to the next."""
    steps = rng.normal(size=mileage.size)
    noise = np.empty(mileage.size)
    noise[0] = steps[0]
    for i in range(1, mileage.size):
        noise[i] = rho * noise[i - 1] + np.sqrt(1 - rho**2) * steps[i]
    return noise
