"""True numbers of simulated vehicles: drawn about nominal, those of twelve separate parts too."""

from collections.abc import Iterable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import torch

from suspnet.ground.parameters import SIDES
from suspnet.ground.settings import check_number
from suspnet.ground.types import FloatArray
from suspnet.trains.simulation.fleet import EFFECTS
from suspnet.vehicle import PARAMETERS, QuarterCar, SpatialVehicle, VerticalVehicle
from suspnet.vehicle.quantities import QUANTITIES, SPATIAL_QUANTITIES, LogNormal
from suspnet.vehicle.vertical_vehicle import VehicleFamily

MAX_DRAWS = 100  # largest number of draws in the search for a physical vehicle
STREAM = b"scatter"
"""Part of the seed that makes these draws independent of those of trips and payload."""
HEALTHY = tuple(f"healthy_{name}" for name in PARAMETERS[:4])
SIDEWAYS = ("frame_sway", "frame_yaw", "body_yaw", "creep")
"""Motion that a vehicle of separate parts has in addition to that of the vertical vehicle."""


def with_separate_parts(generator: Any, effects: Sequence[str] = ()) -> SpatialVehicle:
    """Return the vehicle of twelve separate springs and dampers of a vertical vehicle.

    `effects` are parts of it that the vertical vehicle cannot have.
    Its sensors are those on axle box, frame and body, first the left ones, then the right ones.
    ValueError if the generator is no vertical vehicle, or its sensors are in the middle.
    """
    if not isinstance(generator, VerticalVehicle):
        raise ValueError(
            "a scenario of single springs and dampers needs a vehicle of known geometry and "
            f"generator=family, got {type(generator).__name__}"
        )
    frame = "axle1" if generator.frame_sensor == "axle" else "centre"
    shared = {field.name: getattr(generator, field.name) for field in fields(VehicleFamily)}
    places = ("axle_box_axle1", f"frame_{frame}", "body")
    return SpatialVehicle(
        **shared | {"parts": (*generator.parts, *SIDEWAYS, *effects)},
        sensors=tuple(f"{place}_{side}" for side in SIDES for place in places),
    )


def scattered(generator: Any, scatter: float, seed: int) -> Any:
    """Return a generator whose nominal vehicle has randomly drawn true numbers.

    They are drawn from ``LogNormal.prior`` of its parts, deviations multiplied by `scatter` (0 to
    5) and those of ``EFFECTS`` halved, as their priors are wider than trains differ, until
    ``Vehicle`` accepts them and its motion decays. Of a quarter car the springs and dampers are
    drawn, the masses are not. ValueError if none of ``MAX_DRAWS`` vehicles is physical.
    """
    check_number("scatter", scatter, low=0, high=5)
    if scatter == 0:
        if isinstance(generator, SpatialVehicle) and not _decays(generator):
            raise ValueError(
                f"the vehicle hunts at {generator.speed_m_per_s:g} m/s: its motion does not decay; "
                "lower the speed, or draw other numbers by `scatter` and `seed`"
            )
        return generator
    if not isinstance(generator, QuarterCar | VehicleFamily):
        raise TypeError(f"`scatter` needs a generator of suspnet, got {type(generator).__name__}")
    prior = _prior(generator)
    absent = (prior.offsets > 0) & (prior.median > 0)  # others have either sign
    least = np.where(absent, 0.0, -np.inf)
    of_effects = {q.name for q in SPATIAL_QUANTITIES if q.part in EFFECTS}
    halved = np.array([0.5 if name in of_effects else 1.0 for name in prior.names])
    widths = halved * prior.deviations
    rng = np.random.default_rng([seed, *STREAM])
    for _ in range(MAX_DRAWS):
        steps = scatter * widths * rng.standard_normal(len(prior.names))
        logs = np.maximum(np.array(prior.mean) + steps, least)
        candidate = _with_numbers(generator, prior.names, logs)
        if candidate is not None and _decays(candidate):
            return candidate
    raise ValueError(
        f"none of {MAX_DRAWS} vehicles drawn with `scatter`={scatter} is physical; lower it"
    )


def true_numbers(generator: Any) -> dict[str, dict[str, Any]]:
    """Return value, unit and ratio to nominal of each true number of a generator's vehicle.

    The ratios of a quarter car are 1, as its vehicle holds the true numbers itself.
    """
    quantities = {q.name: q for q in getattr(generator, "quantities", QUANTITIES)}
    if isinstance(generator, QuarterCar):
        nominal, ratios = generator.vehicle.healthy_values()[:4], np.ones(4)
        names: Iterable[str] = HEALTHY
    else:
        names, nominal = quantities, generator.nominal_values()[len(generator.outputs) :]
        distribution = generator.distribution or LogNormal((), (), ())
        medians = dict(zip(distribution.names, distribution.median, strict=True))
        ratios = np.array([medians.get(q.name, q.median) for q in quantities.values()])
    scattered_names = _prior(generator).names
    shown = {
        q.name: q
        for q in quantities.values()
        if q.name in scattered_names or (q.unit and not q.part)
    }
    return {
        name: {"value": value * float(ratio), "unit": shown[name].unit, "ratio": float(ratio)}
        for name, value, ratio in zip(names, nominal, ratios, strict=True)
        if name in shown and name != "speed"
    }


def _prior(generator: QuarterCar | VehicleFamily) -> LogNormal:
    if isinstance(generator, QuarterCar):
        return LogNormal.prior(())
    prior = generator.with_prior().distribution
    assert prior is not None
    return prior


def _with_numbers(
    generator: QuarterCar | VehicleFamily, names: tuple[str, ...], logs: FloatArray
) -> QuarterCar | VehicleFamily | None:
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
    # Responses to the outputs alone use the median of the distribution, here the true numbers.
    return replace(generator, distribution=certain)


def _decays(generator: Any) -> bool:
    healthy = torch.ones(len(getattr(generator, "outputs", PARAMETERS)))
    a, *_ = generator.motion_system(healthy).state_space()
    return bool(np.linalg.eigvals(a).real.max() < 0)
