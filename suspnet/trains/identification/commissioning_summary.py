"""Description of a commissioned vehicle in sentences and in SI units."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.ground.findings import Finding, together
from suspnet.ground.parameters import BOGIE_PARTS, PARAMETERS, kind_of
from suspnet.ground.types import FloatArray
from suspnet.trains.fits.bogie_fit import EXPLAINED, FURTHER_PARTS
from suspnet.trains.fits.commissioning import Commissioned
from suspnet.trains.fits.worn_parts import N_HEALTHY, false_verdicts, least_losses
from suspnet.trains.identification.healthy_trips import HealthyTrips
from suspnet.vehicle.quantities import (
    MASS_DEVIATION,
    MASS_MEAN,
    QUANTITIES,
    UNMEASURED,
    LogNormal,
    Quantity,
)

UNTRUSTED = 5.0
"""Misfit of the healthy trips above which the sensors are to be looked at first."""
IDENTIFIED = 0.8
"""A number is identified if the trips reduce its deviation below this fraction of the prior's."""
NARROW = 0.5
"""Largest standard deviation over the median for which a number is written with plus and minus."""
ODD_MASS = 2.0
"""Deviations of the prior of a trip's mass beyond which the vehicle file's is to be checked."""
MOST_CHANGE = 10.0
"""Ratio of medians after and before from which that before is near 0, and no change is shown."""
PREFIXES = ((1e6, "M"), (1e3, "k"))
"""Prefixes of force units, the largest first."""
PART_TITLES = {
    "": "Springs, dampers, lengths and inertias",
    "bushings": "Bushings of the dampers",
    "rubber": "Rubber of the primary springs",
    "guidance": "Axle guidance",
    "longitudinal": "Longitudinal links between car body and bogie",
    "yaw_dampers": "Yaw dampers between car body and bogie",
    "bending": "First bending of the car body",
    "roll": "Roll, cross level and lateral places",
    "other_bogie": "The bogie that is not measured",
    "payload": "What changes with the payload",
    "sensors": "Sensitivity and delay of the sensors",
    "wheelsets": "Excitation of single wheelsets",
    "axle_box_arm": "Sensor on the arm of the axle box",
    "air_spring": "Air spring",
    "track": "Track under the wheelsets",
    "cross_axis": "Lateral motion that sensors read",
    "second_bending": "Second bending of the car body",
    "equipment": "Equipment hung below the floor",
    "body_torsion": "Torsion of the car body",
    "floors": "Local floors below the sensors",
    "nonlinear_dampers": "Dry friction beside the secondary springs",
}


@dataclass(frozen=True)
class Number:
    """One uncertain number of a vehicle before and after commissioning.

    `nominal` is the value of the drawing. `prior` and `posterior` are the median minus one standard
    deviation, the median, and plus one, in SI units; `deviations` [-] are those of the logarithm in
    prior and posterior.
    """

    quantity: Quantity
    nominal: float
    prior: tuple[float, float, float]
    posterior: tuple[float, float, float]
    deviations: tuple[float, float]

    @property
    def ratio(self) -> float | None:
        """Median of the posterior over that of the prior, [-]; None if that is near 0."""
        before, after = self.prior[1], self.posterior[1]
        is_near_0 = not self.quantity.median or abs(after) >= MOST_CHANGE * abs(before)
        return None if is_near_0 else after / before

    @property
    def uncertainty_left(self) -> float:
        """Deviation of the posterior over the prior's, [-]; 1 if the trips add no information."""
        return self.deviations[1] / self.deviations[0]

    @property
    def is_told(self) -> bool:
        """Whether the trips identify the number."""
        return self.uncertainty_left < IDENTIFIED

    def as_json(self) -> dict[str, Any]:
        """Return the number in SI units, for a file."""
        return {
            "name": self.quantity.name,
            "meaning": self.quantity.meaning,
            "part": self.quantity.part,
            "unit": self.quantity.unit or "1",
            "nominal": self.nominal,
            "prior": _as_json(self.prior, self.deviations[0]),
            "posterior": _as_json(self.posterior, self.deviations[1]),
            "ratio": self.ratio,
            "uncertainty_left": self.uncertainty_left,
            "told": self.is_told,
        }


def numbers(outcome: Commissioned) -> list[Number]:
    """Return every uncertain number, ordered by the part of the vehicle."""
    nominal = dict(
        zip(UNMEASURED, outcome.generator.nominal_values()[len(PARAMETERS) :], strict=True)
    )
    quantity_of = {quantity.name: quantity for quantity in QUANTITIES}
    return _numbers(outcome.prior, outcome.posterior, nominal, quantity_of)


def further_numbers(bogie: CommissionedBogie) -> list[Number]:
    """Return every number of the parts that the healthy trips showed the vehicle to need."""
    quantity_of = {q.name: q for q in bogie.generator.quantities if q.part in FURTHER_PARTS}
    every = bogie.generator.distribution
    assert every is not None
    posterior = every.without([name for name in every.names if name not in quantity_of])
    prior = LogNormal.independent({n: quantity_of[n].deviation for n in posterior.names})
    nominal = {name: quantity.nominal or 1.0 for name, quantity in quantity_of.items()}
    return _numbers(prior, posterior, nominal, quantity_of)


def _numbers(
    before: LogNormal,
    after: LogNormal,
    nominal: Mapping[str, float],
    quantity_of: Mapping[str, Quantity],
) -> list[Number]:
    """Return the numbers of two distributions of the same names."""
    both = before, after
    ends = [
        np.stack([distribution.quantile(n) for n in (-1, 0, 1)], axis=1) for distribution in both
    ]
    uncertain = []
    for i, name in enumerate(before.names):
        prior, posterior = (tuple((nominal[name] * part[i]).tolist()) for part in ends)
        deviations = float(before.deviations[i]), float(after.deviations[i])
        number = Number(quantity_of[name], nominal[name], prior, posterior, deviations)
        uncertain.append(number)
    return sorted(uncertain, key=lambda number: list(PART_TITLES).index(number.quantity.part))


def unplaced(healthy: HealthyTrips) -> str | None:
    """Return a sentence if single sensors are assumed in the middle because no side is given."""
    if not (names := healthy.manifests[0].unplaced):
        return None
    return Finding("sensors-unplaced", names=together(names, ", "))


def of_parts(bogie: CommissionedBogie) -> str:
    """Return a sentence on a bogie of which each part is read, or all of a kind as equal."""
    if not bogie.generator.shows_parts:
        return Finding("kinds-are-read", misfit=bogie.misfit)
    healthy = dict(zip(bogie.healthy.names, bogie.healthy.values, strict=True))
    spreads = {}
    for kind, name in (("k", "springs"), ("c", "dampers")):
        ratios = [
            healthy[part]
            / np.mean([healthy[other] for other in BOGIE_PARTS if kind_of(other) == kind_of(part)])
            for part in BOGIE_PARTS
            if part.startswith(kind)
        ]
        spreads[name] = 100 * max(abs(ratio - 1) for ratio in ratios)
    return Finding("each-part-is-read", misfit=bogie.misfit, **spreads)


SHOWS_MASS = 2 * EXPLAINED
"""Largest misfit of the parts with which the mass of the healthy trips is told."""


def doubts_of_parts(bogie: CommissionedBogie) -> list[str]:
    """Return a sentence for each reason not to rely on a bogie of which each part is read."""
    reasons: list[str] = []
    if bogie.misfit > UNTRUSTED:
        reasons.append(Finding("look-at-sensors-first", untrusted=UNTRUSTED))
    if not bogie.converged:
        reasons.append(Finding("search-unfinished"))
    # what does not explain the trips shows no mass either
    doubt = mass_doubt(bogie.masses) if bogie.misfit <= SHOWS_MASS else None
    return [*reasons, *filter(None, [doubt])]


def errors_of_parts(bogie: CommissionedBogie, healthy: HealthyTrips) -> str:
    """Return a sentence on the errors of a bogie's responses, empty if they are not known."""
    if bogie.errors is None:
        return ""
    largest = 100 * bogie.errors.numpy()
    i, sensor = np.unravel_index(largest.argmax(), largest.shape)
    return Finding(
        "model-errors" if largest.any() else "no-model-errors",
        typical=float(np.median(largest.max(axis=1))),
        most=float(largest.max()),
        frequency=float(healthy.of_parts[0].frequencies_hz[i]),
        place=bogie.generator.places[int(sensor)].replace("_", " "),
    )


def reach_of_parts(bogie: CommissionedBogie) -> str:
    """Return from which loss parts are named, the worst of each kind, and how often wrongly."""
    if not bogie.generator.shows_parts:
        return ""
    wrongly = Finding(
        "healthy-accused", n=N_HEALTHY, n_accused=round(N_HEALTHY * false_verdicts(bogie))
    )
    return together([Finding("named-from", **hardest_losses(least_losses(bogie))), wrongly], " ")


def hardest_losses(losses: Mapping[str, float]) -> dict[str, float]:
    """Return the largest of the losses [-] of the parts of each kind, in %."""
    return {
        kind: 100 * max(loss for name, loss in losses.items() if kind_of(name) == kind)
        for kind in PARAMETERS[:-1]
    }


def mass_doubt(masses: FloatArray) -> str | None:
    """Return a sentence if healthy trips show another car body than the vehicle file.

    `masses` (n_trips,) are over nominal, [-].
    """
    logs = np.log(masses)
    if abs(logs.mean() - MASS_MEAN) <= ODD_MASS * MASS_DEVIATION:
        return None
    return Finding("mass-differs", exp=np.exp(logs.mean()))


def reference(outcome: Commissioned) -> list[str]:
    """Return what healthy means for models of this vehicle, as sentences."""
    number_of = {number.quantity.name: number for number in numbers(outcome)}
    values = [
        f"{name} = {spoken(number_of[f'healthy_{name}'])}"
        for name in PARAMETERS[:4]
        if f"healthy_{name}" in number_of
    ]
    kind = "healthy-now-is" if values else "healthy-now"
    if any("±" in value for value in values):
        kind = "healthy-now-about"
    law = outcome.bogie.law
    return [Finding(kind, values=together(values, ", ")), *(law.findings if law else [])]


def untold(uncertain: Sequence[Number]) -> str:
    """Return a sentence on the numbers that the trips do not determine; empty if there are none."""
    names = [number.quantity.meaning for number in uncertain if not number.is_told]
    if not names:
        return ""
    return Finding(
        "numbers-untold", n_names=len(names), n_found=len(uncertain), names=together(names, "; ")
    )


def spoken(number: Number) -> str:
    """Return a number as commissioned with its uncertainty and unit."""
    scale, unit = _unit(number)
    return f"{_value(*number.posterior, scale)} {unit}".strip()


def cells(number: Number) -> dict[str, Any]:
    """Return a number as a row of a table."""
    scale, unit = _unit(number)
    quantity = number.quantity
    return {
        "symbol": quantity.symbol,
        "unit": unit or "1",
        "prior": _value(*number.prior, scale),
        "posterior": _value(*number.posterior, scale),
        "change": None if number.ratio is None else number.ratio - 1,
        "left": number.uncertainty_left,
        "told": number.is_told,
    }


def _unit(number: Number) -> tuple[float, str]:
    unit = number.quantity.unit
    if unit.startswith("N"):
        for scale, prefix in PREFIXES:
            if number.nominal >= scale:
                return scale, prefix + unit
    return 1.0, unit


def _as_json(ends: tuple[float, float, float], deviation: float) -> dict[str, float]:
    low, median, high = ends
    return {"median": median, "low": low, "high": high, "log_deviation": deviation}


def _value(low: float, median: float, high: float, scale: float) -> str:
    """Return a median with its standard deviation, or with its range where that is large."""
    value, half = median / scale, (high - low) / scale / 2
    if not half:
        return f"{value:g}"
    if half > NARROW * abs(value):
        ends = (_rounded(end / scale, max(abs(end / scale), half / 10)) for end in (low, high))
        return f"{_rounded(value, max(abs(value), half / 10))} ({' to '.join(ends)})"
    return f"{_rounded(value, half)} ± {_rounded(half, half)}"


def _rounded(value: float, least: float) -> str:
    """Return a number with the decimals at which `least` shows two digits."""
    digits = 1 - math.floor(math.log10(abs(least)))
    return f"{round(value, digits) + 0.0:.{max(digits, 0)}f}"  # no minus before 0
