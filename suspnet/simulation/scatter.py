"""True numbers of a simulated vehicle, drawn around those of its drawing as in real vehicles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from suspnet.dynamics import PARAMETERS, QuarterCar, VerticalVehicle
from suspnet.dynamics.quantities import QUANTITIES, UNMEASURED, LogNormal
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray

MAX_DRAWS = 100
"""Largest number of draws in the search for a physical vehicle."""
STREAM = b"scatter"
"""Part of the seed that makes these draws independent of those of trips and payload."""
HEALTHY = tuple(f"healthy_{name}" for name in PARAMETERS[:4])


def scattered(generator: Any, scatter: float, seed: int) -> Any:
    """Return a generator whose nominal vehicle has randomly drawn true numbers.

    They are drawn from ``LogNormal.prior`` of its parts, deviations from the median multiplied by
    `scatter` (0 to 5; 0 changes nothing), until the vehicle is physical: ``Vehicle`` accepts its
    ratios, none is negative, and its motion decays. Of a quarter car the springs and dampers are
    drawn, the masses are not. Raises ValueError if none of ``MAX_DRAWS`` vehicles is physical.
    """
    check_number("scatter", scatter, low=0, high=5)
    if scatter == 0:
        return generator
    if not isinstance(generator, QuarterCar | VerticalVehicle):
        raise TypeError(f"`scatter` needs a generator of suspnet, got {type(generator).__name__}")
    prior = LogNormal.prior(getattr(generator, "parts", ()))
    rng = np.random.default_rng([seed, *STREAM])
    for _ in range(MAX_DRAWS):
        steps = scatter * prior.deviations * rng.standard_normal(len(prior.names))
        logs = np.maximum(np.array(prior.mean) + steps, np.where(prior.offsets > 0, 0.0, -np.inf))
        drawn = _with_numbers(generator, prior.names, logs)
        if drawn is not None and _decays(drawn):
            return drawn
    raise ValueError(
        f"none of {MAX_DRAWS} vehicles drawn with `scatter`={scatter} is physical; lower it"
    )


def true_numbers(generator: Any) -> dict[str, dict[str, Any]]:
    """Return value, unit and ratio to nominal of each number of a generator's vehicle.

    Numbers of parts that the vehicle does not have, the speed and the other bogie's wear are
    omitted. The ratios of a quarter car are 1, as its vehicle holds the true numbers itself.
    """
    if isinstance(generator, QuarterCar):
        nominal, ratios = generator.vehicle.healthy_values()[:4], np.ones(4)
        names: tuple[str, ...] = HEALTHY
    else:
        names, nominal = UNMEASURED, generator.nominal_values()[len(PARAMETERS) :]
        given = generator.distribution or LogNormal((), (), ())
        medians = dict(zip(given.names, given.median, strict=True))
        ratios = np.array([medians.get(name, 1.0) for name in names])
    parts = getattr(generator, "parts", ())
    known = {q.name: q for q in QUANTITIES if q.part in parts or (q.unit and not q.part)}
    return {
        name: {"value": value * float(ratio), "unit": known[name].unit, "ratio": float(ratio)}
        for name, value, ratio in zip(names, nominal, ratios, strict=True)
        if name in known and name != "speed"
    }


def _with_numbers(
    generator: QuarterCar | VerticalVehicle, names: tuple[str, ...], logs: FloatArray
) -> QuarterCar | VerticalVehicle | None:
    """Return the generator with its numbers multiplied; None if ``Vehicle`` rejects them."""
    certain = LogNormal(names, tuple(logs), ((0.0,) * len(names),) * len(names))
    ratios = dict(zip(names, certain.median.tolist(), strict=True))
    try:
        vehicle = generator.vehicle.degraded(
            **{name: ratios[healthy] for name, healthy in zip(PARAMETERS, HEALTHY, strict=False)}
        )
    except ValueError:
        return None
    if isinstance(generator, QuarterCar):
        return replace(generator, vehicle=vehicle)
    # Responses to five columns of ratios use the median of the distribution, here the true numbers.
    return replace(generator, distribution=certain)


def _decays(generator: QuarterCar | VerticalVehicle) -> bool:
    a, *_ = generator.motion_system(torch.ones(len(PARAMETERS))).state_space()
    return bool(np.linalg.eigvals(a).real.max() < 0)
