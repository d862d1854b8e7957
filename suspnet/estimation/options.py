"""Options of measurement: choices of curves, sensors and masses, with the information of each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from torch import Tensor

from suspnet.dynamics import PARAMETERS, VerticalVehicle
from suspnet.estimation.information import (
    cramer_rao,
    fisher_information,
    joint_information,
    without_uncertain,
)
from suspnet.estimation.protocols import RESPONSES, Task
from suspnet.estimation.sensor_information import THREE_SENSORS, places, recording_information
from suspnet.ground.types import FloatArray
from suspnet.spectra.curves import CurveObserver, CurveSettings
from suspnet.spectra.estimates import EstimateObserver, EstimateSettings
from suspnet.spectra.observation import Observer

MASS = "M_s"
SECOND_SET = "a second set of sensors"
PAIR = "a pair of sensors at each place, left and right"
ONE_SIDE = "one sensor at each place, 1 m off the middle"
ONE_SIDE_M = (1.0, 1.0, 1.0)
"""Lateral places [m] of sensors on axle box, frame and body on one side."""
Kind = Literal["baseline", "less", "more", "other", "estimate"]


@dataclass(frozen=True)
class Option:
    """Something that could be measured, with its Fisher information.

    Attributes
    ----------
    title : str
    kind : {"baseline", "less", "more", "other", "estimate"}
        What is measured now, less or more than that, something else instead, or what the
        estimator makes of what is measured now.
    unknown : tuple of str
        The parameters that have to be estimated.
    information : array of shape (n_vehicles, n_unknown, n_unknown)
        With respect to ratios to healthy.
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

        Parameters
        ----------
        ratios : array of shape (n_vehicles, 5), [-]
            Those of the information.
        """
        columns = [PARAMETERS.index(name) for name in self.unknown]
        return np.asarray(100 * cramer_rao(self.information) / ratios[:, columns])


class _FurtherCurves(CurveObserver):
    """The responses from the axle box to a generator's further places on frame and body."""

    def noise_free(self, ratios: Tensor) -> Tensor:
        """Return their magnitudes, shape (n_vehicles, 2, n_freq), [-]."""
        return self.generator.further_channels(ratios, self.frequencies_hz)[:, 0, :2].abs()


def options(task: Task, observer: Observer, ratios: FloatArray) -> list[Option]:
    """Return the options of measurement for a task; the first is what is measured now.

    Of curves: one of them, both, and further ones of the same signal-to-noise ratio. Of trips: the
    recordings of fewer and of more sensors, of pairs and of one side where the vehicle rolls, and
    the estimate that is made of three. Of either: the car-body mass, and twice the sensors.

    Parameters
    ----------
    task : Task
    observer : Observer
    ratios : array of shape (n_vehicles, 5), [-]
    """
    now, *others = _OPTIONS[observer.settings.kind](task, observer, ratios)
    if task.mass_known:
        unmeasured = replace(now, title="car-body mass not measured", kind="less")
        return [*(option.knowing(MASS) for option in (now, *others)), unmeasured]
    measured = replace(now.knowing(MASS), title="+ measured car-body mass", kind="more")
    return [now, *others, measured]


def _from_curves(task: Task, observer: CurveObserver, ratios: FloatArray) -> list[Option]:
    """Return the options of section III-B, all of ``task.varied`` unknown.

    Uncertain numbers are those of one vehicle, whichever curves of it are measured: informations
    add up before these numbers are eliminated.
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
    # the second axle box moves as much as the first: its curve is 1 whatever the parameters
    for place, name in zip(observer.generator.further_places, RESPONSES, strict=False):
        found.append(option(f"+ {place}", "more", now + information(further, name)))
    return [*found, option(f"+ {SECOND_SET}", "more", 2 * now)]


def _against(responses: Sequence[str], measured: Sequence[str]) -> Kind:
    """Return whether responses are more, less or other than those measured."""
    if set(responses) > set(measured):
        return "more"
    return "less" if set(responses) < set(measured) else "other"


def _from_recordings(task: Task, observer: EstimateObserver, ratios: FloatArray) -> list[Option]:
    """Return the options of a trip, all of ``task.varied`` unknown."""
    names = places(observer.generator)
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
    """Return the options of sensors left and right of a vehicle that rolls, and of one side alone.

    The mean of a pair does not see roll and has half the noise of one sensor.
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
            continue  # what is measured now
        source = observer.settings.observer(replace(generator, sensor_lateral_m=lateral_m))
        (information,) = recording_information(source, ratios, task.varied, [count * three])
        found.append(Option(title, kind, task.varied, information))
    return found


_OPTIONS: dict[str, Callable[..., list[Option]]] = {
    CurveSettings.kind: _from_curves,
    EstimateSettings.kind: _from_recordings,
}
"""Function that lists the options, by the kind of the observation."""
