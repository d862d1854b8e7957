"""A family of vehicles: body and two bogies that pitch, four wheelsets on one track.

`VehicleFamily` has the settings and uncertain numbers that all of them share. The equations are in
`suspnet.vehicle.vertical_response`, the motion in time in `suspnet.vehicle.spatial_motion`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.ground.parameters import COMPONENTS, FORWARD, REVERSE, SIDES, Direction, End
from suspnet.ground.settings import Setting, check_choice, check_number, check_settings, setting
from suspnet.ground.tensors import as_tensor, check_device
from suspnet.vehicle.motion import LinearSystem
from suspnet.vehicle.quantities import PARTS, QUANTITIES, SPATIAL_QUANTITIES, LogNormal, Quantity
from suspnet.vehicle.quarter_car import QuarterCar
from suspnet.vehicle.spatial_motion import spatial_motion
from suspnet.vehicle.vehicle import (
    GEOMETRY,
    PARAMETERS,
    ResponseGenerator,
    Vehicle,
    angular,
    check_ratios,
    check_vehicle,
)
from suspnet.vehicle.vertical_motion import Layout, laden
from suspnet.vehicle.vertical_response import bounced, excited, moved, phasor, rolled, wheels_of

OTHER_END: dict[End, End] = {"leading": "trailing", "trailing": "leading"}


@dataclass(frozen=True)
class VehicleFamily:
    """A vehicle with two pitching bogies, its sensors and uncertain numbers.

    `outputs` are the estimated ratios, `possible_parts` what `parts` may hold. ValueError if the
    vehicle's geometry is missing or a setting is out of range.
    """

    outputs: ClassVar[tuple[str, ...]] = PARAMETERS
    possible_parts: ClassVar[tuple[str, ...]] = PARTS

    vehicle: Annotated[
        Vehicle,
        Setting(
            "The vehicle, as the group vehicle gives it; with its four numbers of geometry",
            rule="set by the group",
        ),
    ]
    device: str = setting("cpu", "Device on which curves are made", rule="cpu or cuda")
    speed_m_per_s: float = setting(
        70.0,
        "Speed, as the line's: wheelsets meet the same track one after the other",
        "m/s",
        above=0,
    )
    bogie: End = setting("leading", "Bogie that is measured")
    axle: End = setting("leading", "Axle box of that bogie that is measured")
    direction: Direction = setting(
        FORWARD,
        "Direction of travel: in reverse, what is called leading and ahead runs behind",
    )
    frame_sensor: Literal["axle", "centre"] = setting(
        "axle",
        "Place of the sensor on the bogie frame: above the measured axle, or at the bogie's centre",
    )
    body_sensor_m: float = setting(
        0.0, "Place of the sensor on the body, ahead of the bogie's centre", "m", low=-100, most=100
    )
    other_bogie: Literal["healthy", "same"] = setting(
        "healthy", "The bogie that is not measured: healthy, or as degraded as the measured one"
    )
    parts: tuple[str, ...] = setting(
        (),
        "Parts of the vehicle in addition to rigid bodies on linear springs and dampers",
        rule="list of bushings, rubber, guidance, longitudinal, yaw_dampers, bending, roll, "
        "other_bogie, payload, sensors, wheelsets, axle_box_arm, air_spring",
    )
    sensor_lateral_m: tuple[float, float, float] = setting(
        (0.0, 0.0, 0.0),
        "Lateral places of the sensors on axle box, frame and body; 0 is the mean of a left and "
        "a right one",
        "m",
        low=-2,
        high=2,
    )
    nominal: Mapping[str, float] | None = setting(
        None,
        "Nominal values of quantities of the parts in place of the usual ones, "
        "{bending_frequency: 9.0}",
        rule="mapping, SI units; above 0",
    )
    distribution: LogNormal | None = setting(
        None,
        "Uncertain numbers that training curves sample: prior, or standard deviations of "
        "logarithms, {speed: 0.01}",
        rule="prior, or a mapping to numbers; at least 0 and below 10",
    )

    def __post_init__(self) -> None:
        check_vehicle(self.vehicle)
        check_device(self.device)
        missing = [name for name in GEOMETRY if getattr(self.vehicle, name) is None]
        if missing:
            raise ValueError(
                f"vehicle {self.vehicle.name!r} lacks {missing}, which `{type(self).__name__}` "
                "needs; give them or use generator=quarter_car"
            )
        check_settings(self)
        for part in self.parts:
            check_choice("parts", part, self.possible_parts)
        object.__setattr__(self, "parts", tuple(p for p in self.possible_parts if p in self.parts))
        self._check_places()
        self._check_nominal()
        distribution = LogNormal.read(self.distribution, self._groups, self.quantities)
        object.__setattr__(self, "distribution", distribution)

    def _check_places(self) -> None:
        if len(self.sensor_lateral_m) != 3:
            raise ValueError(
                f"`sensor_lateral_m` must be three places, got {self.sensor_lateral_m}"
            )
        object.__setattr__(self, "sensor_lateral_m", tuple(map(float, self.sensor_lateral_m)))

    def _check_nominal(self) -> None:
        allowed = {quantity.name for quantity in self.quantities if quantity.nominal is not None}
        unknown = sorted(set(self.nominal or {}) - allowed)
        if unknown:
            raise ValueError(f"`nominal` must be named as in {sorted(allowed)}, got {unknown}")
        for name, value in (self.nominal or {}).items():
            check_number(f"nominal.{name}", value, above=0)

    @property
    def quantities(self) -> tuple[Quantity, ...]:
        """Every number that may differ from nominal, the speed first."""
        return QUANTITIES

    @property
    def _groups(self) -> tuple[str, ...]:
        """Values of `Quantity.part` of the numbers that the vehicle has, besides ""."""
        return self.parts

    @cached_property
    def columns(self) -> tuple[str, ...]:
        """Names of all columns of ratios: ``outputs``, then those of the quantities."""
        return (*self.outputs, *(quantity.name for quantity in self.quantities))

    @cached_property
    def offsets(self) -> Tensor:
        """Number added to each column before it is checked or its logarithm is taken, [-].

        It is 1 for numbers that may be absent, whose ratio must be above -1, else 0.
        """
        offsets = [0.0] * len(self.outputs) + [quantity.offset for quantity in self.quantities]
        return torch.tensor(offsets, dtype=torch.float64)

    def with_prior(self) -> Self:
        """Return the vehicle with every number that it has as uncertain as before any trip."""
        return replace(self, distribution=LogNormal.prior(self._groups, self.quantities))

    def sample_unmeasured(self, ratios: ArrayLike, seed: int) -> Tensor:
        """Return ratios (n_vehicles, n_outputs or 1 more) with all ``columns``.

        The uncertain columns are drawn from the distribution, the others are 1.
        """
        rows = as_tensor(ratios).to("cpu", torch.float64)
        if self.distribution is None or not self.distribution.names:
            return self.complete(rows).clone()
        shape = len(rows), len(self.distribution.names)
        standard = np.random.default_rng(seed).standard_normal(shape)
        return self.with_uncertain(rows, torch.as_tensor(self.distribution.ratios(standard)))

    def with_uncertain(self, ratios: Tensor, numbers: Tensor) -> Tensor:
        """Return ratios (n_vehicles, n_outputs or 1 more) with all ``columns``.

        `numbers` are the values of the distribution's names, shape (n_vehicles, n_names), [-].
        """
        columns = torch.tensor(self.uncertain_columns, device=ratios.device)
        return self.complete(ratios).index_copy(1, columns, numbers)

    def running(self, direction: Direction) -> Self:
        """Return the same vehicle with another direction of travel."""
        return replace(self, direction=direction)

    def on(self, device: str) -> Self:
        """Return the same generator on another device."""
        return replace(self, device=device)

    def complete(self, ratios: Tensor) -> Tensor:
        """Return ratios with all columns: missing ones are the distribution's median, else 1."""
        n_outputs, n_all = len(self.outputs), len(self.columns)
        if ratios.ndim == 2 and ratios.shape[1] > n_outputs + 1:
            fits = ratios.shape[1] == n_all
            check_ratios(ratios + self.offsets.to(ratios) if fits else ratios, n_all)
            return ratios
        n_given = ratios.shape[-1] if ratios.ndim == 2 else n_outputs
        check_ratios(ratios, max(n_given, n_outputs))
        columns = self._medians.to(ratios).repeat(len(ratios), 1)
        columns[:, :n_given] = ratios
        if self.other_bogie == "same":
            other = [self.columns.index(f"other_{name}") for name in self.outputs[:4]]
            columns[:, other] = ratios[:, :4]
        return columns

    @cached_property
    def _medians(self) -> Tensor:
        medians = [1.0] * len(self.outputs) + [quantity.median for quantity in self.quantities]
        columns = torch.tensor(medians, dtype=torch.float64)
        if self.distribution is not None:
            columns[self.uncertain_columns] = torch.as_tensor(self.distribution.median)
        return columns

    @cached_property
    def uncertain_columns(self) -> list[int]:
        """Columns of the distribution's names."""
        assert self.distribution is not None
        return [self.columns.index(name) for name in self.distribution.names]

    @property
    def _layout(self) -> Layout:
        bogie, axle, ahead_m = self.bogie, self.axle, self.body_sensor_m
        # The vehicle is symmetric: in reverse the leading bogie moves like a trailing one.
        if self.direction == REVERSE:
            bogie, axle, ahead_m = OTHER_END[bogie], OTHER_END[axle], -ahead_m
        place = bogie, axle, self.frame_sensor, ahead_m
        return Layout(*place, self.parts, self.vehicle.body_mass_kg)

    def _rows(self, ratios: ArrayLike) -> Tensor:
        return self.complete(as_tensor(ratios).to(self.device, torch.float64))

    def _numbers(self, ratios: ArrayLike) -> dict[str, Tensor]:
        """Return every number of the vehicle in SI units, each of shape (n_vehicles, 1)."""
        return self._in_si(self._rows(ratios))

    def _in_si(self, columns: Tensor) -> dict[str, Tensor]:
        """Return every number in SI units from ratios with all columns, which are not checked."""
        values = (columns * self._nominal).T.unsqueeze(-1)
        p = dict(zip(self.columns, values, strict=True))
        for name in PARAMETERS[:4]:  # these columns are relative to the uncertain healthy values
            p[f"other_{name}"] = p[f"other_{name}"] * p[f"healthy_{name}"]
        p |= self._measured(p)
        return laden(p, self.vehicle.body_mass_kg) if "payload" in self.parts else p

    def _measured(self, p: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return springs and dampers of the measured bogie from ratios and healthy values."""
        return {name: p[name] * p[f"healthy_{name}"] for name in PARAMETERS[:4]}

    @cached_property
    def _nominal(self) -> Tensor:
        return torch.tensor(self.nominal_values(), dtype=torch.float64, device=self.device)

    def nominal_values(self) -> tuple[float, ...]:
        """Return the values at a ratio of 1, SI units; those that multiply healthy values are 1."""
        v = self.vehicle
        values = dict(
            zip((f"healthy_{name}" for name in PARAMETERS), v.healthy_values(), strict=True)
        )
        values |= {"speed": self.speed_m_per_s, "bogie_mass": v.bogie_mass_kg}
        values |= {name.removesuffix("_m"): float(getattr(v, name)) for name in GEOMETRY}
        places = zip(("axle_box", "frame", "body"), self.sensor_lateral_m, strict=True)
        values |= {f"{name}_lateral": place for name, place in places} | dict(self.nominal or {})
        first = (1.0,) * (len(self.outputs) - 1) + (float(v.body_mass_kg),)
        return first + tuple(
            float(values.get(q.name, 1.0 if q.nominal is None else q.nominal))
            for q in self.quantities
        )


@dataclass(frozen=True)
class VerticalVehicle(VehicleFamily, ResponseGenerator):
    """Frequency responses axle box -> frame -> body of a vehicle with two pitching bogies."""

    def responses(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> tuple[Tensor, Tensor]:
        """Return complex G_p (axle box to frame sensor) and G_s (frame to body sensor).

        They are the responses to the mean of both rails, each (n_vehicles, n_freq); see `channels`.
        `ratios` has the columns ``PARAMETERS`` and, if given, speed or all of ``UNMEASURED``,
        relative to nominal. ValueError if it has another shape or a value that is not positive and
        finite (not above -1 for numbers that may be absent).
        """
        p, omega = self._numbers(ratios), angular(frequencies_hz, self.device)
        wheels = wheels_of(self._layout, p, omega)
        box, frame, body = (moved(place, wheels) for place in self._felt(p, omega))
        return frame / box, body / frame

    def channels(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return axle box, frame and body for each input, (n_vehicles, n_inputs, 3, n_freq), [-].

        The inputs are the mean of both rails, then what excites each wheelset alone if `parts` has
        wheelsets, then the cross level if `rolls`, scaled such that each input has the density of
        the mean.
        """
        p, omega = self._numbers(ratios), angular(frequencies_hz, self.device)
        places, wheels = self._felt(p, omega), wheels_of(self._layout, p, omega)
        channels = excited(self._layout, p, wheels, places)
        if not self.rolls:
            return channels
        turned = rolled(self._layout, p, omega)
        if "sensors" in self.parts:
            gains = [_gain(p, name, omega) for name in ("frame", "body")]
            turned = turned * torch.stack([torch.ones_like(gains[0]), *gains], dim=1)
        return torch.cat([channels, turned[:, None]], dim=1)

    def _felt(self, p: Mapping[str, Tensor], omega: Tensor) -> list[list[Tensor]]:
        """Return what axle box, frame and body sensor measure per metre under each wheelset."""
        box, *others = bounced(self._layout, p, omega)
        if "sensors" in self.parts:
            gains = [_gain(p, name, omega) for name in ("frame", "body")]
            others = [
                list(map(gain.mul, per_wheel))
                for gain, per_wheel in zip(gains, others, strict=True)
            ]
        return [box, *others]

    @property
    def rolls(self) -> bool:
        """Whether sensors measure roll: the vehicle has roll, and a sensor is off the middle."""
        return "roll" in self.parts and any(self.sensor_lateral_m)

    def of(self, vehicle: Vehicle) -> ResponseGenerator:
        """Return the generator with these settings for another vehicle; see `best_generator`."""
        if all(getattr(vehicle, name) is None for name in GEOMETRY):
            return QuarterCar(vehicle, self.device)
        return replace(self, vehicle=vehicle)

    def motion_system(self, ratios: ArrayLike) -> LinearSystem:
        """Return the equations of motion of one vehicle, its ratios (5,), (6,) or all columns.

        Sensitivity and delay of sensors, and what excites single wheelsets, are no part of it.
        """
        felt = tuple(part for part in self.parts if part != "roll" or self.rolls)
        # twelve separate springs and dampers, of which those of a kind are equal
        p = {q.name: torch.tensor([[q.nominal or 1.0]]) for q in SPATIAL_QUANTITIES}
        p |= self._numbers(as_tensor(ratios)[None])
        for whose in "", "other_":
            p |= {f"{whose}{name}": p[f"{whose}{name[:3]}"] for name in COMPONENTS[:-1]}
        sides = SIDES if self.rolls else ("middle",)
        frame = "frame_axle1" if self.frame_sensor == "axle" else "frame_centre"
        places = [f"{place}_{side}" for side in sides for place in (frame, "body")]
        return spatial_motion(replace(self._layout, parts=felt), p, places)


def _gain(p: Mapping[str, Tensor], sensor: str, omega: Tensor) -> Tensor:
    """Return what the sensor on "frame" or "body" makes of an acceleration, (n, n_freq)."""
    return phasor(omega * p[f"{sensor}_delay"]) * p[f"{sensor}_gain"]


def best_generator(vehicle: Vehicle, device: str = "cpu", **settings: Any) -> ResponseGenerator:
    """Return a vertical vehicle if the geometry is known, else a quarter car.

    `settings` are those of ``VerticalVehicle``; the quarter car ignores them.
    """
    if all(getattr(vehicle, name) is None for name in GEOMETRY):
        return QuarterCar(vehicle, device)
    return VerticalVehicle(vehicle, device, **settings)
