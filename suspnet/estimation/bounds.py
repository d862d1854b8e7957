"""Identifiability in numbers and words: bounds, uncertain directions, and helpful additions.

All bounds are relative standard deviations in percent, Cramer-Rao: no unbiased estimator has less;
a Gaussian error has a MAPE of 0.8 times that. They are infinite where nothing can be identified.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspnet.dynamics import PARAMETERS
from suspnet.estimation.options import Option
from suspnet.ground.types import FloatArray

VERDICTS = ((1.0, "well"), (5.0, "fairly"), (20.0, "poorly"))
"""Thresholds of the bounds' 95th percentile over the range, [%]; above all of them the verdict is
"not"."""
UNIDENTIFIED = "not"
PERCENTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
TAKES_PART = 0.3
"""Least component of a parameter that takes part in a direction, relative to the largest."""
SINGULAR = 1e-12
"""Eigenvalue relative to the largest below which a direction has no information."""
WORTH_HAVING = 0.9
"""Largest ratio of bounds, after over before, at which an addition counts as helpful."""


@dataclass(frozen=True)
class Bound:
    """The bound of one parameter when something is measured.

    Attributes
    ----------
    parameter : str
    healthy_percent : float, [%]
        At the healthy vehicle.
    percentiles : tuple of floats, [%]
        Over the range, at ``PERCENTILES``; not interpolated, since bounds may be infinite.
    """

    parameter: str
    healthy_percent: float
    percentiles: tuple[float, ...]

    @property
    def median_percent(self) -> float:
        """Median over the range, [%]."""
        return self.percentiles[2]

    @property
    def p95_percent(self) -> float:
        """95th percentile over the range, [%]."""
        return self.percentiles[4]

    @property
    def verdict(self) -> str:
        """How well the parameter is identified, by its 95th percentile: see ``VERDICTS``."""
        fitting = (word for threshold, word in VERDICTS if self.p95_percent <= threshold)
        return next(fitting, UNIDENTIFIED)


def with_healthy(ratios: FloatArray) -> FloatArray:
    """Return the ratios with the healthy vehicle in front, shape (1 + n_vehicles, 5), [-]."""
    return np.concatenate([np.ones((1, len(PARAMETERS))), ratios])


def bounds(option: Option, ratios: FloatArray) -> list[Bound]:
    """Return the bound of each unknown parameter of an option.

    Parameters
    ----------
    option : Option
    ratios : array of shape (1 + n_vehicles, 5), [-]
        Those of the information, from `with_healthy`.
    """
    percent = option.percent(ratios)
    spread = np.quantile(percent[1:], PERCENTILES, axis=0, method="inverted_cdf")
    return [
        Bound(name, float(percent[0, j]), tuple(spread[:, j].tolist()))
        for j, name in enumerate(option.unknown)
    ]


@dataclass(frozen=True)
class Direction:
    """An eigenvector of the information on logarithmic parameters: what is uncertain together.

    Attributes
    ----------
    parameters : tuple of str
    components : array of shape (n_parameters,), [-]
        Relative changes, of length 1, the largest positive.
    deviation_percent : float, [%]
        Standard deviation along the direction; inf where it leaves the curves unchanged.
    """

    parameters: tuple[str, ...]
    components: FloatArray
    deviation_percent: float

    @property
    def taking_part(self) -> dict[str, float]:
        """The parameters that move noticeably, and their components."""
        largest = np.abs(self.components).max()
        pairs = zip(self.parameters, self.components.tolist(), strict=True)
        return {name: part for name, part in pairs if abs(part) >= TAKES_PART * largest}

    @property
    def changes_percent(self) -> dict[str, float]:
        """How one standard deviation along the direction changes each parameter, [%].

        The squares of a parameter's changes, summed over all directions, are its bound squared.
        """
        changes = self.components * self.deviation_percent
        return dict(zip(self.parameters, changes.tolist(), strict=True))

    def words(self) -> str:
        """Return which parameters move, and whether together or against each other."""
        parts = self.taking_part
        up = [name for name, part in parts.items() if part > 0]
        down = [name for name, part in parts.items() if part < 0]
        if len(parts) == 1:
            return f"{up[0]} moves alone"
        if not down:
            return f"{listed(up)} move together"
        if len(parts) == 2:
            return f"{listed(list(parts))} move against each other"
        return f"{listed(up)} {'move together' if len(up) > 1 else 'moves'} against {listed(down)}"


def directions(information: FloatArray, parameters: Sequence[str]) -> list[Direction]:
    """Return the eigenvectors of the information on logarithmic parameters, weakest first.

    A parameter without any information is a direction of its own.

    Parameters
    ----------
    information : array of shape (n_parameters, n_parameters)
        With respect to ratios, at the healthy vehicle: there, with respect to logarithms as well.
    parameters : sequence of str
    """
    names, size = tuple(parameters), len(parameters)
    seen = np.diag(information) > 0
    found = [Direction(names, row, math.inf) for row in np.eye(size)[~seen]]
    eigenvalues, vectors = np.linalg.eigh(information[np.ix_(seen, seen)])
    for eigenvalue, vector in zip(eigenvalues, vectors.T, strict=True):
        components = np.zeros(size)
        components[seen] = vector * np.sign(vector[np.abs(vector).argmax()])
        informative = eigenvalue > SINGULAR * eigenvalues[-1]
        deviation = 100 / math.sqrt(eigenvalue) if informative else math.inf
        found.append(Direction(names, components, deviation))
    return found


def best_addition_sentence(table: Sequence[tuple[Option, Sequence[Bound]]]) -> str:
    """Return one sentence that names, for each parameter, the addition that lowers its bound most.

    Parameters
    ----------
    table : sequence of (Option, its bounds)
        The baseline first. Medians over the range are compared.
    """
    parts = []
    for now in table[0][1]:
        additions = [
            (bound.median_percent, option.title.removeprefix("+ "))
            for option, found in table
            for bound in found
            if option.kind == "more" and bound.parameter == now.parameter
        ]
        least, title = min(additions)
        if least <= WORTH_HAVING * now.median_percent and math.isfinite(least):
            before = now.median_percent
            was = f"{before:.2g}" if math.isfinite(before) else "not identified"
            parts.append(f"{now.parameter}, {title} ({was} to {least:.2g} %)")
        else:
            parts.append(f"{now.parameter}, nothing listed")
    return f"What lowers each bound most: {'; '.join(parts)}."


def listed(names: Sequence[str]) -> str:
    """Return names as a list in words: a, b and c."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
