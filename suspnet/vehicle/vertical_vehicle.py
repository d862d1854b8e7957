"""A family of vehicles: body and two bogies that pitch, four wheelsets on one track.

The equations are in `suspnet.vehicle.vertical_response`, the motion in time in
`suspnet.vehicle.vertical_motion`, settings and numbers in `suspnet.vehicle.vehicle_family`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.ground.tensors import as_tensor
from suspnet.vehicle.motion import LinearSystem
from suspnet.vehicle.quarter_car import QuarterCar
from suspnet.vehicle.vehicle import GEOMETRY, ResponseGenerator, Vehicle
from suspnet.vehicle.vehicle_family import VehicleFamily
from suspnet.vehicle.vertical_motion import primary_element, secondary_element, vertical_motion
from suspnet.vehicle.vertical_response import bounced, excited, moved, phasor, rolled, wheels_of


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
        p, omega = self._prepared(ratios, frequencies_hz)
        wheels = wheels_of(self._layout, p, omega)
        box, frame, body = (moved(place, wheels) for place in self._felt(p, omega))
        return frame / box, body / frame

    def channels(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return axle box, frame and body for each input, (n_vehicles, n_inputs, 3, n_freq), [-].

        The inputs are the mean of both rails, then what excites each wheelset alone if `parts` has
        wheelsets, then the cross level if `rolls`, scaled such that each input has the density of
        the mean.
        """
        p, omega = self._prepared(ratios, frequencies_hz)
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

    def dynamic_stiffness(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return kappa_p and kappa_s of the measured bogie, (n_vehicles, 2, n_freq), [N/m]."""
        p, omega = self._prepared(ratios, frequencies_hz)
        return torch.stack(
            [
                element(p, "", self.parts).at(omega)
                for element in (primary_element, secondary_element)
            ],
            dim=1,
        )

    def motion_system(self, ratios: ArrayLike) -> LinearSystem:
        """Return the equations of motion of one vehicle, its ratios (5,), (6,) or all columns.

        Sensitivity and delay of sensors, and what excites single wheelsets, are no part of it.
        """
        felt = tuple(part for part in self.parts if part != "roll" or self.rolls)
        layout = replace(self._layout, parts=felt)
        return vertical_motion(layout, self._numbers(as_tensor(ratios)[None]))


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
