"""A family of vehicles: body and two bogies that pitch, four wheelsets on one track.

This module holds its numbers, sensors and uncertain quantities. The equations are in
`suspnet.dynamics.vertical_response`, the motion in time in `suspnet.dynamics.vertical_motion`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.dynamics.motion import LinearSystem
from suspnet.dynamics.quantities import (
    MEDIANS,
    OFFSETS,
    PARTS,
    QUANTITIES,
    UNMEASURED,
    LogNormal,
)
from suspnet.dynamics.quarter_car import QuarterCar
from suspnet.dynamics.vehicle import (
    GEOMETRY,
    PARAMETERS,
    ResponseGenerator,
    Vehicle,
    check_ratios,
    check_vehicle,
)
from suspnet.dynamics.vertical_motion import (
    Layout,
    laden,
    primary_element,
    secondary_element,
    vertical_motion,
)
from suspnet.dynamics.vertical_response import (
    bounced,
    excited_alone,
    on_arm,
    phasor,
    rolled,
    wheels_of,
)
from suspnet.ground.parameters import FORWARD, REVERSE, Direction
from suspnet.ground.settings import Setting, check_choice, check_number, check_settings, setting
from suspnet.ground.tensors import as_tensor, check_device

End = Literal["leading", "trailing"]
OTHER_END: dict[End, End] = {"leading": "trailing", "trailing": "leading"}
N_ALL = len(PARAMETERS) + len(UNMEASURED)
_OTHER = [len(PARAMETERS) + UNMEASURED.index(f"other_{name}") for name in PARAMETERS[:4]]
"""Columns of the bogie that is not measured."""
_OFFSETS = torch.tensor([0.0] * len(PARAMETERS) + list(OFFSETS.values()), dtype=torch.float64)
"""Added to ratios before they are checked: those that may be absent must be above -1, not 0."""
_DEFAULTS = torch.tensor([1.0] * len(PARAMETERS) + list(MEDIANS.values()), dtype=torch.float64)


@dataclass(frozen=True)
class VerticalVehicle:
    """Frequency responses axle box -> frame -> body of a vehicle with two pitching bogies.

    Raises
    ------
    TypeError, ValueError
        If the vehicle's geometry is missing or a setting is out of range.
    """

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
    bogie: Literal["leading", "trailing"] = setting("leading", "Bogie that is measured")
    axle: Literal["leading", "trailing"] = setting(
        "leading", "Axle box of that bogie that is measured"
    )
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
        rule="list of bushings, rubber, guidance, longitudinal, bending, roll, other_bogie, "
        "payload, sensors, wheelsets, axle_box_arm, air_spring",
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
                f"vehicle {self.vehicle.name!r} lacks {missing}, which `VerticalVehicle` needs; "
                "give them or use generator=quarter_car"
            )
        check_settings(self)
        for part in self.parts:
            check_choice("parts", part, PARTS)
        object.__setattr__(self, "parts", tuple(p for p in PARTS if p in self.parts))
        self._check_places()
        self._check_nominal()
        object.__setattr__(self, "distribution", LogNormal.read(self.distribution, self.parts))

    def _check_places(self) -> None:
        if len(self.sensor_lateral_m) != 3:
            raise ValueError(
                f"`sensor_lateral_m` must be three places, got {self.sensor_lateral_m}"
            )
        object.__setattr__(self, "sensor_lateral_m", tuple(map(float, self.sensor_lateral_m)))

    def _check_nominal(self) -> None:
        allowed = {quantity.name for quantity in QUANTITIES if quantity.nominal is not None}
        unknown = sorted(set(self.nominal or {}) - allowed)
        if unknown:
            raise ValueError(f"`nominal` must be named as in {sorted(allowed)}, got {unknown}")
        for name, value in (self.nominal or {}).items():
            check_number(f"nominal.{name}", value, above=0)

    def sample_unmeasured(self, ratios: Tensor | ArrayLike, seed: int) -> Tensor:
        """Return ratios (n_vehicles, 5 or 6) with a column for each name of ``UNMEASURED``.

        The uncertain columns are drawn from the distribution, the others are 1.
        """
        rows = as_tensor(ratios).to("cpu", torch.float64)
        if self.distribution is None or not self.distribution.names:
            return self.complete(rows).clone()
        shape = len(rows), len(self.distribution.names)
        standard = np.random.default_rng(seed).standard_normal(shape)
        return self.with_uncertain(rows, torch.as_tensor(self.distribution.ratios(standard)))

    def with_uncertain(self, ratios: Tensor, numbers: Tensor) -> Tensor:
        """Return ratios (n_vehicles, 5 or 6) with a column for each name of ``UNMEASURED``.

        `numbers` are the values of the distribution's names, shape (n_vehicles, n_names), [-].
        """
        columns = torch.tensor(self.uncertain_columns, device=ratios.device)
        return self.complete(ratios).index_copy(1, columns, numbers)

    def responses(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> tuple[Tensor, Tensor]:
        """Return complex G_p (axle box to frame sensor) and G_s (frame to body sensor).

        They are the responses to the mean of both rails, each (n_vehicles, n_freq); see `channels`.
        `ratios` has the columns ``PARAMETERS`` and, if given, speed or all of ``UNMEASURED``,
        relative to nominal. ValueError if it has another shape or a value that is not positive and
        finite (not above -1 for numbers that may be absent).
        """
        p, omega = self._prepared(ratios, frequencies_hz)
        above, frame, body = bounced(self._layout, p, omega)
        if "sensors" in self.parts:
            _, of_frame, of_body = self._gains(p, omega).unbind(dim=1)
            frame, body = frame * of_frame, body * of_body
        box = on_arm(p, torch.ones_like(above), above) if "axle_box_arm" in self.parts else 1.0
        return frame / box, body / frame

    def channels(self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike) -> Tensor:
        """Return axle box, frame and body for each input, (n_vehicles, n_inputs, 3, n_freq), [-].

        The inputs are the mean of both rails, then what excites each wheelset alone if `parts` has
        wheelsets, then the cross level if `rolls`, scaled such that each input has the density of
        the mean.
        """
        p, omega = self._prepared(ratios, frequencies_hz)
        wheels: Sequence[Tensor] = wheels_of(self._layout, p, omega)
        box = torch.ones_like(wheels[0])
        if "wheelsets" in self.parts:
            wheels, box = excited_alone(self._layout, p, wheels)
        above, frame, body = bounced(self._layout, p, omega, wheels)
        if "axle_box_arm" in self.parts:
            box = on_arm(p, box, above)
        found = torch.stack([box, frame, body], dim=-2)
        found = found.movedim(0, 1) if "wheelsets" in self.parts else found[:, None]
        if self.rolls:
            found = torch.cat([found, rolled(self._layout, p, omega)[:, None]], dim=1)
        return found * self._gains(p, omega)[:, None] if "sensors" in self.parts else found

    def _gains(self, p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
        """Return what axle box, frame and body sensor make of an acceleration, (n, 3, n_freq)."""
        late = [
            phasor(omega * p[f"{name}_delay"]) * p[f"{name}_gain"] for name in ("frame", "body")
        ]
        return torch.stack([torch.ones_like(late[0]), *late], dim=1)

    @property
    def rolls(self) -> bool:
        """Whether sensors measure roll: the vehicle has roll, and a sensor is off the middle."""
        return "roll" in self.parts and any(self.sensor_lateral_m)

    def magnitudes(self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike) -> Tensor:
        """Return abs(G_p) and abs(G_s) as one real tensor of shape (n_vehicles, 2, n_freq)."""
        return torch.stack(self.responses(ratios, frequencies_hz), dim=1).abs()

    @property
    def further_places(self) -> tuple[str, ...]:
        """Names of places for further sensors: on the frame, on the body, the other axle box."""
        elsewhere = self._elsewhere
        frame = {"centre": "frame centre", "axle": "frame above the axle"}[elsewhere.frame_sensor]
        bogie = "other" if elsewhere.body_sensor_m else "measured"
        return frame, f"body above the {bogie} bogie", "second axle box"

    def further_channels(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> Tensor:
        """Return responses at ``further_places``, (n_vehicles, n_inputs, n_places, n_freq), [-].

        The second axle box follows the track a wheelbase later, or earlier if it leads.
        """
        channels = self._elsewhere.channels(ratios, frequencies_hz)
        both = wheels_of(self._layout, *self._prepared(ratios, frequencies_hz))[:2]
        late = both[1 if self._layout.axle == "leading" else 0][:, None, None]
        second = replace(self, axle=OTHER_END[self.axle]).channels(ratios, frequencies_hz)[:, :, :1]
        # what excites a wheelset alone has no delay between axles
        of_track = [0, -1] if self.rolls else [0]
        second[:, of_track] = late * second[:, of_track]
        return torch.cat([channels[:, :, 1:], second], dim=2)

    @property
    def _elsewhere(self) -> VerticalVehicle:
        """The generator with its frame and body sensor moved to the further places."""
        half_pivot_m = self.vehicle.half_pivot_distance_m
        assert half_pivot_m is not None
        other_m = -2 * half_pivot_m if self.bogie == "leading" else 2 * half_pivot_m
        body_sensor_m = 0.0 if math.isclose(self.body_sensor_m, other_m) else other_m
        frame_sensor: Literal["axle", "centre"] = (
            "centre" if self.frame_sensor == "axle" else "axle"
        )
        return replace(self, frame_sensor=frame_sensor, body_sensor_m=body_sensor_m)

    def of(self, vehicle: Vehicle) -> ResponseGenerator:
        """Return the generator with these settings for another vehicle; see `best_generator`."""
        if all(getattr(vehicle, name) is None for name in GEOMETRY):
            return QuarterCar(vehicle, self.device)
        return replace(self, vehicle=vehicle)

    def running(self, direction: Direction) -> VerticalVehicle:
        """Return the same vehicle with another direction of travel."""
        return replace(self, direction=direction)

    def on(self, device: str) -> VerticalVehicle:
        """Return the same generator on another device."""
        return replace(self, device=device)

    def assumptions(self) -> str:
        """Return a sentence that states the assumptions of the generator."""
        n_uncertain = 0 if self.distribution is None else len(self.distribution.names)
        if n_uncertain:
            return (
                f"The vehicle pitches; {n_uncertain} of its numbers are uncertain and estimated "
                "too, all others are taken as known exactly."
            )
        return (
            "The vehicle pitches; speed, geometry, inertias and the other bogie are taken as known "
            "exactly."
        )

    def dynamic_stiffness(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> Tensor:
        """Return kappa_p and kappa_s of the measured bogie, (n_vehicles, 2, n_freq), [N/m]."""
        p, omega = self._prepared(ratios, frequencies_hz)
        return torch.stack(
            [one(p, "", self.parts).at(omega) for one in (primary_element, secondary_element)],
            dim=1,
        )

    def motion_system(self, ratios: Tensor | ArrayLike) -> LinearSystem:
        """Return the equations of motion of one vehicle, its ratios (5,), (6,) or all columns.

        Sensitivity and delay of sensors, and what excites single wheelsets, are no part of it.
        """
        felt = tuple(part for part in self.parts if part != "roll" or self.rolls)
        layout = replace(self._layout, parts=felt)
        return vertical_motion(layout, self._numbers(as_tensor(ratios)[None]))

    def complete(self, ratios: Tensor) -> Tensor:
        """Return ratios with all columns: missing ones are the distribution's median, else 1."""
        if ratios.ndim == 2 and ratios.shape[1] > len(PARAMETERS) + 1:
            fits = ratios.shape[1] == N_ALL
            check_ratios(ratios + _OFFSETS.to(ratios) if fits else ratios, N_ALL)
            return ratios
        n_given = ratios.shape[-1] if ratios.ndim == 2 else len(PARAMETERS)
        check_ratios(ratios, max(n_given, len(PARAMETERS)))
        columns = _DEFAULTS.to(ratios).repeat(len(ratios), 1)
        if self.distribution is not None:
            columns[:, self.uncertain_columns] = torch.as_tensor(self.distribution.median).to(
                ratios
            )
        columns[:, :n_given] = ratios
        if self.other_bogie == "same":
            columns[:, _OTHER] = ratios[:, :4]
        return columns

    @property
    def uncertain_columns(self) -> list[int]:
        """Columns of the distribution's names."""
        assert self.distribution is not None
        return [len(PARAMETERS) + UNMEASURED.index(name) for name in self.distribution.names]

    @property
    def _layout(self) -> Layout:
        bogie, axle, ahead_m = self.bogie, self.axle, self.body_sensor_m
        # The vehicle is symmetric: in reverse the leading bogie moves like a trailing one.
        if self.direction == REVERSE:
            bogie, axle, ahead_m = OTHER_END[bogie], OTHER_END[axle], -ahead_m
        place = bogie, axle, self.frame_sensor, ahead_m
        return Layout(*place, self.parts, self.vehicle.body_mass_kg)

    def _prepared(
        self, ratios: Tensor | ArrayLike, frequencies_hz: Tensor | ArrayLike
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Return every number of the vehicles in SI units, and the angular frequencies [rad/s]."""
        bins = as_tensor(frequencies_hz).to(self.device, torch.float64)
        return self._numbers(ratios), 2 * math.pi * bins

    def _numbers(self, ratios: Tensor | ArrayLike) -> dict[str, Tensor]:
        """Return every number of the vehicle in SI units, each of shape (n_vehicles, 1)."""
        columns = self.complete(as_tensor(ratios).to(self.device, torch.float64))
        nominal = torch.tensor(self.nominal_values(), dtype=torch.float64, device=self.device)
        values = (columns * nominal).T.unsqueeze(-1)
        p = dict(zip((*PARAMETERS, *UNMEASURED), values, strict=True))
        for name in PARAMETERS[:4]:  # these columns are relative to the uncertain healthy values
            p[name] = p[name] * p[f"healthy_{name}"]
            p[f"other_{name}"] = p[f"other_{name}"] * p[f"healthy_{name}"]
        return laden(p, self.vehicle.body_mass_kg) if "payload" in self.parts else p

    def nominal_values(self) -> tuple[float, ...]:
        """Return the values at a ratio of 1, SI units; those that multiply healthy values are 1."""
        v = self.vehicle
        given = dict(
            zip((f"healthy_{name}" for name in PARAMETERS), v.healthy_values(), strict=True)
        )
        given |= {"speed": self.speed_m_per_s, "bogie_mass": v.bogie_mass_kg}
        given |= {name.removesuffix("_m"): float(getattr(v, name)) for name in GEOMETRY}
        places = zip(("axle_box", "frame", "body"), self.sensor_lateral_m, strict=True)
        given |= {f"{name}_lateral": place for name, place in places} | dict(self.nominal or {})
        first = (1.0, 1.0, 1.0, 1.0, float(v.body_mass_kg))
        standard = (1.0 if q.nominal is None else q.nominal for q in QUANTITIES)
        return first + tuple(
            float(given.get(q.name, value)) for q, value in zip(QUANTITIES, standard, strict=True)
        )


def best_generator(vehicle: Vehicle, device: str = "cpu", **settings: Any) -> ResponseGenerator:
    """Return a vertical vehicle if the geometry is known, else a quarter car.

    `settings` are those of ``VerticalVehicle``; the quarter car ignores them.
    """
    if all(getattr(vehicle, name) is None for name in GEOMETRY):
        return QuarterCar(vehicle, device)
    return VerticalVehicle(vehicle, device, **settings)
