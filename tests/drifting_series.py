"""A parameter that drifts, with noise that is correlated from trip to trip."""

import numpy as np
from scipy.signal import lfilter


def autoregressive(noise, correlation):
    """Return a stationary series of unit variance from white noise e of unit variance.

    y_t = phi y_(t-1) + sqrt(1 - phi^2) e_t along the first axis, and y_0 = e_0.
    """
    spread = np.sqrt(1 - correlation**2)
    first = (1 - spread) * noise[:1]
    return lfilter([spread], [1, -correlation], noise, axis=0, zi=first)[0]


def history(n_trips=97, seed=0, rate=-0.03, spread=0.004, rho=0.4):
    """Return mileages in 100,000 km, values and the noise that is known of each trip."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.01, 0.03, n_trips))
    t -= t[0]
    noise = autoregressive(rng.normal(size=n_trips), rho)
    return t, (1 + rate * t) * np.exp(spread * noise), np.full(n_trips, spread)
