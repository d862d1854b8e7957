"""Several trips of one fault as one estimate.

Trip i gives the logarithms e_i of the parts with the covariance T_i + D of
`suspnet.trains.fits.bogie_fit`, where T_i = C_i + tau^2 V. Of T_i, the fraction f = 1 / (n + 1) is
due to the n healthy trips that all are relative to, the rest to the trip alone. Their estimate ::

    e = W^-1 sum_i T_i^-1 e_i,    W = sum_i T_i^-1,
    covariance = (1 - f) W^-1 + f mean_i T_i + D(e)

The intervals in a history give the diagonal of T_i; the correlations of C_i are those of the
healthy trips' noise.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import norm

from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.ground.parameters import BOGIE_PARTS
from suspnet.ground.types import FloatArray
from suspnet.trains.fits.bogie_fit import PartsEstimate, wear_errors
from suspnet.trains.fits.worn_parts import scatter_of_parts

LEAST_NOISE = 0.1
"""Least deviation by noise, of that of an interval: what else widens it is known to no more."""


def joint_estimate(
    bogie: CommissionedBogie, logs: FloatArray, half_widths: FloatArray, level: float
) -> PartsEstimate:
    """Return the estimate of ``BOGIE_PARTS`` of several trips together.

    `logs` (n_trips, 12) and `half_widths` (n_trips, 12) are the logarithms of the ratios, and those
    of the ends of their intervals of that level over them. ValueError if the scatter of the healthy
    trips is not known, or the sensors do not show each part.
    """
    found = scatter_of_parts(bogie)
    noise, scatter = np.array(found.noise), found.widened(level)
    sizes = np.sqrt(np.diag(noise))
    correlation = noise / sizes[:, None] / sizes
    deviations = half_widths / norm.ppf((1 + level) / 2)
    totals, n_sensors = [], len(bogie.generator.places)
    for of_trip, deviation in zip(logs, deviations, strict=True):
        by_wear, _ = wear_errors(bogie.misfit, np.append(of_trip, 0.0), n_sensors)
        variance = deviation**2 - np.diag(scatter) - by_wear[:-1]
        own = np.sqrt(np.maximum(variance, (LEAST_NOISE * deviation) ** 2))
        totals.append(own[:, None] * correlation * own + scatter)
    weights = np.linalg.inv(totals)
    whole = np.linalg.inv(weights.sum(axis=0))
    joint = whole @ np.einsum("tij,tj->i", weights, logs)
    shared = 1 / (found.n_trips + 1)
    covariance = (1 - shared) * whole + shared * np.mean(totals, axis=0)
    by_wear, own = wear_errors(bogie.misfit, np.append(joint, 0.0), n_sensors)
    covariance = covariance + np.diag(by_wear[:-1])
    return PartsEstimate(np.exp(joint), covariance, 1.0, True, level, BOGIE_PARTS, own[:-1])
