"""Options of measurement, and how well each would identify every parameter.

All bounds are Cramer-Rao bounds: relative standard deviations in percent, inf where a parameter is
not identifiable. No unbiased estimator has less; a Gaussian error has a MAPE of 0.8 times that.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from torch import Tensor

from suspnet.bounds.information import (
    cramer_rao,
    fisher_information,
    joint_information,
    without_uncertain,
)
from suspnet.bounds.sensor_information import (
    THREE_SENSORS,
    recording_information,
    sensor_places,
)
from suspnet.curves.curves import CurveObserver, CurveSettings
from suspnet.curves.estimate_observer import EstimateObserver
from suspnet.curves.estimates import EstimateSettings, Observer
from suspnet.curves.protocols import RESPONSES, Task, columns_of
from suspnet.ground.parameters import BODY_MASS
from suspnet.ground.types import FloatArray
from suspnet.vehicle import PARAMETERS, VerticalVehicle

SECOND_SET = "a second set of sensors"
PAIR = "a pair of sensors at each place, left and right"
ONE_SIDE = "one sensor at each place, 1 m off the middle"
ONE_SIDE_M = (1.0, 1.0, 1.0)
"""Lateral places [m] of sensors on axle box, frame and body on one side."""
Kind = Literal["baseline", "less", "more", "other", "estimate"]
VERDICTS = ((1.0, "well"), (5.0, "fairly"), (20.0, "poorly"))
"""Thresholds of the bounds' 95th percentile over the range, [%]; above the last one the verdict is
`UNIDENTIFIED`."""
UNIDENTIFIED = "not"
PERCENTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
TAKES_PART = 0.3
"""Smallest component of a parameter listed in a direction, relative to the largest component."""
SINGULAR = 1e-12
"""Eigenvalue relative to the largest below which a direction has no information."""


@dataclass(frozen=True)
class Option:
    """A choice of measurements with its Fisher information.

    `kind` is what is measured now, less or more than that, another choice, or the information left
    in the estimator's result for what is measured now. `unknown` parameters have to be estimated;
    `information` (n_vehicles, n_unknown, n_unknown) is with respect to ratios to healthy.
    """

    title: str
    kind: Kind
    unknown: tuple[str, ...]
    information: FloatArray

    def knowing(self, parameter: str) -> Option:
        """Return the option with one parameter measured by other means."""
        kept = [j for j, name in enumerate(self.unknown) if name != parameter]
        unknown = tuple(self.unknown[j] for j in kept)
        return replace(self, unknown=unknown, information=self.information[:, kept][:, :, kept])

    def percent(self, ratios: FloatArray) -> FloatArray:
        """Return the bounds relative to each vehicle's own values, (n_vehicles, n_unknown), [%].

        `ratios` (n_vehicles, 5) are those of the information.
        """
        columns = columns_of(self.unknown)
        return np.asarray(100 * cramer_rao(self.information) / ratios[:, columns])


class _FurtherCurves(CurveObserver):
    """Responses from the axle box to a generator's further places on frame and body."""

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return the magnitudes of the further responses, shape (n_vehicles, 2, n_freq), [-]."""
        return self.generator.further_channels(ratios, self.frequencies_hz)[:, 0, :2].abs()


def options(task: Task, observer: Observer, ratios: FloatArray) -> list[Option]:
    """Return the options of measurement for a task; the first is what is measured now.

    For curves: one of them, both, and further ones. For trips: recordings of fewer and more
    sensors, of pairs and of one side where the vehicle rolls, and the estimate from three sensors.
    For both: the car-body mass, and twice the sensors. `ratios`: (n_vehicles, 5).
    """
    now, *others = _OPTIONS[observer.settings.kind](task, observer, ratios)
    if task.mass_known:
        unmeasured = replace(now, title="car-body mass not measured", kind="less")
        return [*(option.knowing(BODY_MASS) for option in (now, *others)), unmeasured]
    measured = replace(now.knowing(BODY_MASS), title="+ measured car-body mass", kind="more")
    return [now, *others, measured]


def _from_curves(task: Task, observer: CurveObserver, ratios: FloatArray) -> list[Option]:
    """Return the options of section III-B, with all of ``task.varied`` unknown.

    All curves share one vehicle's uncertain numbers, so their information is summed before these
    numbers are eliminated.
    """

    def information(source: CurveObserver, response: str) -> FloatArray:
        return joint_information(source, ratios, task.varied, (response,), observer.directions)

    def option(title: str, kind: Kind, total: FloatArray) -> Option:
        return Option(title, kind, task.varied, without_uncertain(total, len(task.varied)))

    primary, secondary = (information(observer, name) for name in RESPONSES)
    curves = {
        ("G_p",): ("only G_p", primary),
        ("G_s",): ("only G_s", secondary),
        RESPONSES: ("both curves", primary + secondary),
    }
    measured = tuple(name for name in RESPONSES if name in task.responses)
    now = curves[measured][1]
    found = [option(curves[measured][0], "baseline", now)]
    for responses, (title, total) in curves.items():
        if responses != measured:
            found.append(option(title, _against(responses, measured), total))
    further = _FurtherCurves(observer.settings, observer.generator)
    # the second axle box moves as much as the first, so its curve is always 1
    for place, name in zip(observer.generator.further_places, RESPONSES, strict=False):
        found.append(option(f"+ {place}", "more", now + information(further, name)))
    return [*found, option(f"+ {SECOND_SET}", "more", 2 * now)]


def _against(responses: Sequence[str], measured: Sequence[str]) -> Kind:
    if set(responses) > set(measured):
        return "more"
    return "less" if set(responses) < set(measured) else "other"


def _from_recordings(task: Task, observer: EstimateObserver, ratios: FloatArray) -> list[Option]:
    """Return the options of a trip, all of ``task.varied`` unknown."""
    names = sensor_places(observer.generator)
    one = np.eye(len(names))
    three = one[: len(THREE_SENSORS)].sum(axis=0)
    choices = {"three sensors": three}
    choices |= {f"without the {name}": three - one[j] for j, name in enumerate(THREE_SENSORS)}
    further = names[len(THREE_SENSORS) :]
    choices |= {f"+ {name}": three + one[names.index(name)] for name in further}
    choices[f"+ {SECOND_SET}"] = 2 * three
    found = recording_information(observer, ratios, task.varied, list(choices.values()))
    kinds: dict[float, Kind] = {-1.0: "less", 0.0: "baseline", 1.0: "more"}
    recorded = [
        Option(title, kinds[np.sign(count.sum() - three.sum())], task.varied, information)
        for (title, count), information in zip(choices.items(), found, strict=True)
    ]
    recorded += _sides(task, observer, ratios, three)
    estimate = fisher_information(observer, ratios, task.varied)
    title = f"three sensors, {observer.settings.method} estimate"
    return [*recorded, Option(title, "estimate", task.varied, estimate)]


def _sides(
    task: Task, observer: EstimateObserver, ratios: FloatArray, three: FloatArray
) -> list[Option]:
    """Return the options of sensors on both sides of a vehicle that rolls, and on one side.

    The mean of a pair does not measure roll and has half the noise of one sensor.
    """
    generator = observer.generator
    if not isinstance(generator, VerticalVehicle) or "roll" not in generator.parts:
        return []
    kinds: tuple[tuple[str, Kind, tuple[float, float, float], float], ...] = (
        (PAIR, "more", (0.0, 0.0, 0.0), 2.0),
        (ONE_SIDE, "less", ONE_SIDE_M, 1.0),
    )
    found = []
    for title, kind, lateral_m, count in kinds:
        if kind == "less" and generator.rolls:
            continue  # this is the baseline already
        source = observer.settings.observer(replace(generator, sensor_lateral_m=lateral_m))
        (information,) = recording_information(source, ratios, task.varied, [count * three])
        found.append(Option(title, kind, task.varied, information))
    return found


_OPTIONS: dict[str, Callable[..., list[Option]]] = {
    CurveSettings.kind: _from_curves,
    EstimateSettings.kind: _from_recordings,
}
"""Function that lists the options, by the kind of observation."""


@dataclass(frozen=True)
class Bound:
    """The bound of one parameter for an option.

    `healthy_percent` is that of the healthy vehicle; `percentiles` are over the range, at
    ``PERCENTILES``, not interpolated because bounds may be infinite; all in [%].
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
        """How well the parameter is identified, from the 95th percentile and ``VERDICTS``."""
        fitting = (word for threshold, word in VERDICTS if self.p95_percent <= threshold)
        return next(fitting, UNIDENTIFIED)


def with_healthy(ratios: FloatArray) -> FloatArray:
    """Return the ratios with the healthy vehicle prepended, shape (1 + n_vehicles, 5), [-]."""
    return np.concatenate([np.ones((1, len(PARAMETERS))), ratios])


def bounds(option: Option, ratios: FloatArray) -> list[Bound]:
    """Return the bound of each unknown parameter of an option.

    `ratios` (1 + n_vehicles, 5) are those of the information, from `with_healthy`.
    """
    percent = option.percent(ratios)
    spread = np.quantile(percent[1:], PERCENTILES, axis=0, method="inverted_cdf")
    return [
        Bound(name, float(percent[0, j]), tuple(spread[:, j].tolist()))
        for j, name in enumerate(option.unknown)
    ]


@dataclass(frozen=True)
class Direction:
    """An eigenvector of the information on logarithmic parameters: a joint uncertainty.

    `components` (n_parameters,) are relative changes, of norm 1, the largest positive;
    `deviation_percent` is the standard deviation along them, inf if they do not change the curves.
    """

    parameters: tuple[str, ...]
    components: FloatArray
    deviation_percent: float

    @property
    def taking_part(self) -> dict[str, float]:
        """The parameters with a noticeable component, and that component."""
        largest = np.abs(self.components).max()
        pairs = zip(self.parameters, self.components.tolist(), strict=True)
        return {name: part for name, part in pairs if abs(part) >= TAKES_PART * largest}

    @property
    def changes_percent(self) -> dict[str, float]:
        """Change of each parameter for one standard deviation along the direction, [%].

        A parameter's bound squared is the sum of the squares of these over all directions.
        """
        changes = self.components * self.deviation_percent
        return dict(zip(self.parameters, changes.tolist(), strict=True))

    def words(self) -> str:
        """Return which parameters change, and whether in the same or in opposite directions."""
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

    `information` is that at the healthy vehicle, where ratios and logarithms have the same one. A
    parameter without any information is a direction of its own.
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


def listed(names: Sequence[str]) -> str:
    """Return names as a list in a sentence: a, b and c."""
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)
