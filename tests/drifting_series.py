"""A parameter that drifts, with noise that is correlated from trip to trip."""

import numpy as np


def history(n_trips=97, seed=0, rate=-0.03, spread=0.004, rho=0.4):
    """Return mileages in 100,000 km, values and the noise that is known of each trip."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.01, 0.03, n_trips))
    t -= t[0]
    noise = np.empty(n_trips)
    noise[0] = rng.normal()
    for i in range(1, n_trips):
        noise[i] = rho * noise[i - 1] + np.sqrt(1 - rho**2) * rng.normal()
    return t, (1 + rate * t) * np.exp(spread * noise), np.full(n_trips, spread)
