"""Sensors and bogies that manifests confuse: two sensors in each other's place, the other bogie.

For each two sensors, the residuals of `suspnet.spectra.subspace` at the median vehicle are computed
with them exchanged, model errors of ``SPREADS[1]`` allowed for. Where an exchange lowers their rms,
the trip is fitted with the sensors as given and exchanged, and the misfits of both decide.

Left and right have their place in the residuals by the roll that they show. On two times three
trains of tests/blind_train.py, plain and with everything at once, with up to twelve worn parts, 30
to 130 %, no exchange of two of six sensors lowered the rms of 210 correct trips, with the drawing's
vehicle (at least 1.002 times as large) or the commissioned one (1.01 times). Of 432 trips with two
sensors swapped, each was found by its own exchange, with the drawing alone. A fit with the drawing
then had 1.5 to 5.3 times the misfit of the right order (24 trips), with the commissioned vehicle 4
to 60 times that of noise (66 trips).

Healthy trips that the vehicle does not explain are fitted as of its other bogie, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from suspnet.dynamics import SpatialVehicle
from suspnet.dynamics.vehicle_family import OTHER_END
from suspnet.estimation.bogie_fit import healthy_search
from suspnet.estimation.bogie_search import ROUGH, BogieSearch
from suspnet.recordings.errors import TripError
from suspnet.spectra.bogie_trip import BogieTrip, smallest_noise

CLEARER = 1.25
"""Factor by which the misfit must fall for two sensors to be called swapped."""
OTHER_BOGIE = 2.0
"""Likewise for the other bogie. Four trips of a leading bogie had 15 and 1.1."""


def check_order(generator: SpatialVehicle, trip: BogieTrip, where: str = "") -> None:
    """Raise TripError if two sensors of a trip look swapped.

    `generator` is the vehicle as its drawing or its healthy trips show it, with a distribution; the
    message starts with `where`.
    """
    assert generator.sensors is not None
    best = likeliest_order(generator, trip)
    moved = [i for i, place in enumerate(best) if place != i]
    if not moved:
        return
    search = _search(generator, trip)
    given = search.widened(ROUGH[0]).finished().misfit
    other = _search(generator, trip.in_order(best)).widened(ROUGH[0]).finished().misfit
    if not other < given / CLEARER:
        return
    there = search.sensors_of(trip)
    names = [generator.sensors[there[i]] for i in moved]
    raise TripError(
        f"{where}{' and '.join(names)} look swapped: with them exchanged the misfit falls from "
        f"{given:.2g} to {other:.2g} times that of noise; exchange the columns of their lines in "
        "the manifest"
    )


def check_bogie(
    generator: SpatialVehicle, trips: Sequence[BogieTrip], misfit: float, where: str = ""
) -> None:
    """Raise TripError if healthy trips fit the vehicle's other bogie, and not their own.

    `misfit` is that of the vehicle that was commissioned on them, `generator` what it started from.
    """
    if misfit < OTHER_BOGIE:
        return
    end = OTHER_END[generator.bogie]
    # near the minimum is near enough, and takes half as long
    other = healthy_search(replace(generator, bogie=end), trips).widened(ROUGH[0]).misfit
    if other < misfit / OTHER_BOGIE:
        raise TripError(
            f"{where}the healthy trips fit the {end} bogie, with a misfit of {other:.2g} times the "
            f"noise, and not the {generator.bogie} one that is given, with {misfit:.2g}; correct "
            "`bogie` in the manifests, or generator.bogie"
        )


def likeliest_order(generator: SpatialVehicle, trip: BogieTrip) -> list[int]:
    """Return the numbers of a trip's sensors as given, or with those two exchanged that fit better.

    That is decided at the median vehicle.
    """
    search = _search(generator, trip)
    orders = [list(range(len(search.sensors_of(trip))))]
    for i, j in combinations(orders[0], 2):
        orders.append(list(orders[0]))
        orders[-1][i], orders[-1][j] = j, i
    return orders[int(np.argmin(search.misfits_in(orders)))]


def _search(generator: SpatialVehicle, trip: BogieTrip) -> BogieSearch:
    return BogieSearch(generator, [smallest_noise(trip.spectra)], [trip], are_healthy=False)
