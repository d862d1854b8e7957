"""A bogie at its prior in the place of a fit to healthy trips, which would take long."""

import numpy as np
import torch

from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter


def fitted_at_once(vehicle, trips, converged=True):
    """Return what ``commission_bogie`` would of healthy trips."""
    masses, n_sensors = np.linspace(1.0, 1.1, len(trips)), len(vehicle.sensors)
    noise = tuple(map(tuple, (1e-4 * np.eye(12 if vehicle.shows_parts else 4)).tolist()))
    scatter = HealthyScatter((0.0,) * 4, (0.01,) * 4, len(trips), noise)
    errors = torch.zeros(len(trips[0].frequencies_hz), n_sensors, dtype=torch.float64)
    of_sensors = torch.full((n_sensors,), 1e-6, dtype=torch.float64)
    loads_m = np.full((len(trips), 2), 0.1)
    return CommissionedBogie(
        vehicle, of_sensors, masses, 1.02, converged, scatter, None, errors, loads_m
    )
