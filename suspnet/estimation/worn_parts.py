"""Which of a bogie's twelve parts have worn: a verdict with odds, as wear is sparse.

An estimate gives the logarithms e of the twelve ratios with the covariance C. Parts that have not
worn scatter by ``USUAL``, worn ones by ``WEAR`` as well. For a set W of worn parts::

    log P(e | W) = -1/2 (e^T V^-1 e + log det V),    V = C + USUAL^2 + WEAR^2 on the diagonal of W

A part has worn with the prior probability ``RARE``. Parts join W one after the other, the most
probable next one first, as long as the odds of W with it over W without it exceed 20 : 1. Where
another part in its place is not 20 times less probable, they are named together. The estimates
themselves are not changed by this.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from suspnet.estimation.bogie_fit import WEAR, PartsEstimate
from suspnet.ground.parameters import BOGIE_PARTS, kind_of, place_words
from suspnet.ground.types import FloatArray

USUAL = {"k": 0.005, "c": 0.015}
"""Standard deviation of the logarithm of a part that has not worn, of springs and of dampers:
temperature and load are not the same from trip to trip."""
RARE = 0.01
"""Prior probability that a part has worn."""
ODDS = 20.0
"""Odds from which a part is named."""
MOST_ODDS = 1000.0
"""Odds above which no number is told: they are those of a model."""


@dataclass(frozen=True)
class WornPart:
    """A part that has worn, or several of which one has.

    `names` are of ``COMPONENTS``, the most probable first; `odds` are those of wear over none;
    `ratio` is the estimate of the first one, [-].
    """

    names: tuple[str, ...]
    odds: float
    ratio: float

    @property
    def is_named(self) -> bool:
        """Whether one part alone is accused."""
        return len(self.names) == 1


def worn_words(worn: Sequence[WornPart]) -> str:
    """Return the worn parts as text: "c_p of axle 1, left at 62 % (odds over 1000 : 1)"."""
    return "; ".join(map(_words, worn))


def _words(one: WornPart) -> str:
    odds = f"over {MOST_ODDS:.0f}" if one.odds > MOST_ODDS else f"{one.odds:.0f}"
    where = " or ".join(f"{kind_of(name)} of {place_words(name)}" for name in one.names)
    unknown = "" if one.is_named else ", which of them is not known"
    return f"{where} at {100 * one.ratio:.3g} % of healthy (odds {odds} : 1{unknown})"


def worn_parts(estimate: PartsEstimate) -> list[WornPart]:
    """Return the parts that have worn, the most certain first; none if none has."""
    logs = np.log(estimate.values[: len(BOGIE_PARTS)])
    usual = np.diag([USUAL[name[0]] ** 2 for name in BOGIE_PARTS])
    covariance = estimate.covariance[: len(BOGIE_PARTS), : len(BOGIE_PARTS)] + usual
    worn: list[int] = []
    found: list[WornPart] = []
    prior = math.log(RARE / (1 - RARE))
    for _ in BOGIE_PARTS:  # each round names one part or ends
        rest = [j for j in range(len(BOGIE_PARTS)) if j not in worn]
        without = _log_probability(logs, covariance, worn)
        gains = {j: _log_probability(logs, covariance, [*worn, j]) - without + prior for j in rest}
        order = sorted(rest, key=gains.__getitem__, reverse=True)
        best = order[0]
        if gains[best] < math.log(ODDS):
            break
        alike = [j for j in order if gains[best] - gains[j] < math.log(ODDS)]
        worn.append(best)
        odds = math.exp(min(gains[best], 700.0))
        names = tuple(BOGIE_PARTS[j] for j in alike)
        found.append(WornPart(names, odds, float(estimate.values[best])))
        if len(worn) == len(BOGIE_PARTS):
            break
    return found


def _log_probability(logs: FloatArray, covariance: FloatArray, worn: list[int]) -> float:
    """Return log P(e | W) up to a constant."""
    whole = covariance.copy()
    whole[worn, worn] += WEAR**2
    sign, size = np.linalg.slogdet(whole)
    assert sign > 0
    return float(-0.5 * (logs @ np.linalg.solve(whole, logs) + size))
