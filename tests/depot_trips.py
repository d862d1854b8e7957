"""Trips of made-up suspensions for the tests of a depot."""

import numpy as np

from suspnet.ground.records import Place, Quality, TripResult

N_TRIPS = 40
SPREAD = {"k_p": 0.0005, "c_p": 0.003, "k_s": 0.0006, "c_s": 0.001, "M_s": 0.05}


def place(side, car="3"):
    return Place("secondary", side=side, train="12", car=car)


def read_trip(where, i, values, spread=SPREAD, **fields):
    """Return the i-th trip of a suspension, 2000 km and three days after the one before."""
    day = np.datetime64("2025-11-01T06:00:00") + np.timedelta64(3 * i, "D")
    given = {"half_widths": {name: 2 * s for name, s in spread.items()}, "estimates": values}
    given |= {"quality": Quality(speed_m_per_s=70.0), "start": f"{day}+00:00"}
    return TripResult(f"trip_{i:03d}", "", "am96", where, 2000.0 * (i + 1), **given, **fields)


def trips(where, seed, wear=(), n_trips=N_TRIPS):
    """Return the trips of a suspension; `wear` has the ratios of some parameters on each trip."""
    random = np.random.default_rng(seed)
    results = []
    for i in range(n_trips):
        values = {name: float(np.exp(s * random.standard_normal())) for name, s in SPREAD.items()}
        for name, ratios in dict(wear).items():
            values[name] *= ratios[i]
        results.append(read_trip(where, i, values))
    return results
