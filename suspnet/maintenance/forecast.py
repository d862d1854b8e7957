"""Remaining lives of the parameters of a suspension, if its trips determine them."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import ArrayLike

from suspnet.ground.parameters import Limits
from suspnet.ground.types import FloatArray
from suspnet.maintenance.degradation import FleetPrior
from suspnet.maintenance.life import MIN_TRIPS, Life, predict_life

MOST_RATIO = 100.0
MOST_WIDTH = 1.0
"""Factor from healthy, and half-width in logarithms, beyond which a trip is not used."""
Trips = tuple[FloatArray, FloatArray, FloatArray]
"""Mileage [km], estimates and half-widths of the trips from which a life is predicted."""


def remaining_lives(
    mileage_km: ArrayLike,
    values: Mapping[str, ArrayLike],
    half_widths: Mapping[str, ArrayLike],
    flagged: ArrayLike,
    limits: Mapping[str, Limits],
    passed: Collection[str] = (),
    fleet: Mapping[str, FleetPrior] | None = None,
    seed: int = 0,
) -> dict[str, Life]:
    """Return the distribution of the mileage until each parameter passes its act limit.

    Parameters without limits, or with fewer than ``MIN_TRIPS`` usable trips, are left out.

    Parameters
    ----------
    mileage_km : array of shape (n_trips,), [km]
        Since the last maintenance, in any order; NaN: not used.
    values, half_widths : mapping from parameter to array of shape (n_trips,), [-]
        Relative to healthy, and half-widths of their intervals in logarithms; NaN: none.
    flagged : bool array of shape (n_trips,)
        Trips that are not used.
    limits : mapping from parameter to Limits
    passed : collection of str
        Parameters with an alarm of the act limit: their remaining life is 0.
    fleet : mapping of FleetPrior, optional
        Prior of each parameter from suspensions of this type (``learn_fleet``).
    seed : int

    Returns
    -------
    dict from parameter to Life
    """
    found = {}
    for name, limit in limits.items():
        if name not in values:
            continue
        trips = trips_of_life(mileage_km, values[name], half_widths[name], flagged)
        if name in passed:
            found[name] = Life("no trend", np.zeros(1))
        elif trips is not None:
            found[name] = predict_life(*trips, limit.act, fleet=(fleet or {}).get(name), seed=seed)
    return found


def why_unknown(
    mileage_km: ArrayLike, values: ArrayLike, half_widths: ArrayLike, flagged: ArrayLike
) -> str:
    """Return why these trips do not determine a remaining life; empty if they do."""
    if trips_of_life(mileage_km, values, half_widths, flagged) is not None:
        return ""
    known, doubtful = np.isfinite(np.asarray(values, dtype=float)), np.asarray(flagged, dtype=bool)
    n_known, n_clear = int(known.sum()), int((known & ~doubtful).sum())
    if not n_known:
        return "no trip with an estimate"
    if not n_clear:
        return "all trips are flagged" if n_known > 1 else "the only trip is flagged"
    if n_clear < MIN_TRIPS:
        return (
            f"too few trips ({n_clear} of {MIN_TRIPS}{' without a flag' if doubtful.any() else ''})"
        )
    return "too few trips with a mileage and an estimate that is certain enough"


def trips_of_life(
    mileage_km: ArrayLike, values: ArrayLike, half_widths: ArrayLike, flagged: ArrayLike
) -> Trips | None:
    """Return the trips usable for predicting a life, by mileage; None if there are too few.

    Flagged trips, estimates beyond a factor of ``MOST_RATIO`` and half-widths above ``MOST_WIDTH``
    are left out.
    """
    km, centre, width = (
        np.asarray(column, dtype=float) for column in (mileage_km, values, half_widths)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        known = (np.abs(np.log(centre)) <= np.log(MOST_RATIO)) & ~(width > MOST_WIDTH)
    used = np.isfinite(km) & known & ~np.asarray(flagged, dtype=bool)
    order = np.flatnonzero(used)[np.argsort(km[used], kind="stable")]
    if len(order) < MIN_TRIPS or km[order[-1]] <= km[order[0]]:
        return None
    return km[order], centre[order], np.where(np.isfinite(width), width, np.nan)[order]
