"""A vehicle of which each spring and damper of the measured bogie is a part of its own.

The equations are in `suspnet.vehicle.spatial_motion`, the responses and their derivatives in
`suspnet.vehicle.spatial_response`, settings and numbers in `suspnet.vehicle.vertical_vehicle`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from suspnet.ground.parameters import COMPONENTS, DAMPERS
from suspnet.ground.settings import check_choice, setting
from suspnet.ground.tensors import as_tensor
from suspnet.vehicle.motion import LinearSystem
from suspnet.vehicle.quantities import (
    ADDITIONS,
    PARTS,
    PLACES,
    QUANTITIES,
    SPATIAL_QUANTITIES,
    LogNormal,
    Quantity,
    show_parts,
)
from suspnet.vehicle.spatial_motion import is_lateral, spatial_motion
from suspnet.vehicle.spatial_response import (
    alone_responses,
    derivatives,
    input_names,
    responses,
    strokes,
)
from suspnet.vehicle.vehicle import angular
from suspnet.vehicle.vertical_motion import Layout
from suspnet.vehicle.vertical_vehicle import VehicleFamily


@dataclass(frozen=True)
class SpatialVehicle(VehicleFamily):
    """Frequency responses of any sensors of a vehicle with twelve separate springs and dampers.

    Ratios have the columns ``COMPONENTS`` and, if given, the speed or all of ``columns``. Those of
    springs and dampers are relative to the healthy ones of this vehicle, which differ by their own
    quantities ("healthy_k_p_axle1_left", ...) from the healthy mean of their kind, as those of the
    other bogie do ("other_k_p_axle1_left", ...). `parts` may also hold frame_sway, frame_yaw,
    body_yaw, creep (sway and yaw of the wheelsets), torsion (of the frames), track (that gives way
    under the wheelsets), second_bending and body_torsion, equipment (hung below the floor),
    floors (local ones below the body's sensors), cross_axis (of the sensors), load (whose centre of
    mass may be anywhere) and nonlinear_dampers (``estimation/suspension_law.py``, with dry friction
    beside secondary springs); roll is always one of them. The vehicle is the vertical one where
    nothing differs and these are absent. `sensors` are from ``PLACES``, by default a pair at axle
    box 1, at `frame_sensor` and on the body; sensitivities and delays are relative to the first.

    Examples
    --------
    >>> from suspnet import SpatialVehicle, read_vehicles
    >>> vehicle = SpatialVehicle(read_vehicles()["am96"], parts=("frame_sway", "frame_yaw"))
    >>> vehicle.inputs
    ('mean', 'cross_level', 'alignment')
    >>> vehicle.channels([[1.0] * 13], [1.0, 2.0]).shape
    torch.Size([1, 3, 6, 2])
    """

    outputs: ClassVar[tuple[str, ...]] = COMPONENTS
    possible_parts: ClassVar[tuple[str, ...]] = (*PARTS, *ADDITIONS)

    sensor_lateral_m: tuple[float, float, float] = setting(
        (1.0, 1.0, 1.0),
        "Lateral places of left sensors on axle box, frame and body; right ones are opposite",
        "m",
        above=0,
        high=2,
    )
    sensors: tuple[str, ...] | None = setting(
        None,
        "Places of the sensors; null is a pair at axle box 1, at `frame_sensor` and on the body",
        rule=f"list of {', '.join(PLACES)}; or null",
    )
    speed_scatter: float = setting(
        0.0,
        "Relative standard deviation of the speed; responses are averaged over it",
        low=0,
        high=1,
    )

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", ("roll", *self.parts))
        places = self._paired() if self.sensors is None else tuple(self.sensors)
        for place in places:
            check_choice("sensors", place, PLACES)
        if not places or len(set(places)) < len(places):
            raise ValueError(f"`sensors` must be places, each once, got {places}")
        object.__setattr__(self, "sensors", places)
        super().__post_init__()
        if self.other_bogie == "same":
            raise ValueError(
                "`other_bogie` must be 'healthy' where each part may wear, got 'same'; give "
                "`other_k_p` and so on as columns"
            )

    def _paired(self) -> tuple[str, ...]:
        frame = "axle1" if self.frame_sensor == "axle" else "centre"
        return tuple(
            f"{place}_{side}"
            for place in ("axle_box_axle1", f"frame_{frame}", "body")
            for side in ("left", "right")
        )

    def with_parts(self, parts: Sequence[str]) -> Self:
        """Return the vehicle with further parts, their numbers as uncertain as before any trip."""
        missing = [part for part in parts if part not in self.parts]
        vehicle = replace(self, parts=(*self.parts, *missing), distribution=None)
        added = LogNormal.independent(
            {q.name: q.deviation for q in vehicle.quantities if q.part in missing}
        )
        known = self.distribution or LogNormal.independent({})
        return replace(vehicle, distribution=known.extended(added))

    @cached_property
    def quantities(self) -> tuple[Quantity, ...]:  # noqa: D102
        measuring = {f"{kind}_{place}" for kind in ("gain", "delay") for place in self.places[1:]}
        measuring |= {f"cross_axis_{place}" for place in self.places}
        measuring |= {
            f"floor_{kind}_{place}"
            for kind in ("mass", "softness", "damping")
            for place in self._on_body
        }
        return (
            # those of yaw dampers are among its own
            *(q for q in QUANTITIES if q.part not in ("sensors", "yaw_dampers")),
            *(
                quantity
                for quantity in SPATIAL_QUANTITIES
                if quantity.part not in ("sensors", "floors", "cross_axis")
                or quantity.name in measuring
            ),
        )

    @property
    def in_middle(self) -> bool:
        """Whether all sensors are in the middle: they measure the mean of both rails alone."""
        return all(place.endswith("_middle") for place in self.places)

    @property
    def shows_parts(self) -> bool:
        """Whether the sensors show each spring and damper; else all of a kind are equal."""
        return show_parts(self.places)

    def seen_prior(self) -> Self:
        """Return the vehicle with its prior, without numbers that no sensor in the middle sees."""
        vehicle = self.with_prior()
        assert vehicle.distribution is not None
        if not self.in_middle:
            return vehicle
        rolling = [q.name for q in self.quantities if q.part == "roll" or q.name == "yaw_lateral"]
        return replace(vehicle, distribution=vehicle.distribution.without(rolling))

    @property
    def _groups(self) -> tuple[str, ...]:
        return (*self.parts, "lateral") if is_lateral(self.parts) else self.parts

    @property
    def places(self) -> tuple[str, ...]:
        """Places of the sensors."""
        assert self.sensors is not None
        return self.sensors

    @property
    def _on_body(self) -> tuple[str, ...]:
        return tuple(place for place in self.places if place.startswith("body"))

    @property
    def _layout(self) -> Layout:
        floors = self._on_body if "floors" in self.parts else ()
        return replace(super()._layout, floors=floors, speed_scatter=self.speed_scatter)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs.

        They are the mean of both rails, half their cross level, their alignment if `parts` moves
        frames or wheelsets laterally, and, with the part wheelsets, what lifts and what rolls each
        wheelset alone.
        """
        return input_names(self.parts)

    def channels(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return the response of each sensor to each input, acceleration per acceleration.

        Complex, (n_vehicles, n_inputs, n_sensors, n_freq), [-]; the inputs are scaled to the
        density of the mean and delayed from wheelset to wheelset, axle 1 first. `frequencies_hz`:
        (n_freq,), above 0. ValueError if `ratios` has another shape or a value that is not positive
        and finite (not above -1 for numbers that may be absent), or if a frequency is not.
        """
        rows, omega = self._rows(ratios), self._bins(frequencies_hz)
        return responses(self._layout, self._in_si, self.places, rows, omega)

    def channels_alone(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return the response of each sensor to each input of the track under one wheelset alone.

        Complex, (n_vehicles, n_kinds, 4, n_sensors, n_freq), [-], scaled as those of `channels`;
        the kinds are mean, cross level and, if `inputs` has it, alignment. `channels` is the sum
        over wheelsets with their delays. ValueError as of `channels`.
        """
        rows, omega = self._rows(ratios), self._bins(frequencies_hz)
        return alone_responses(self._layout, self._in_si, self.places, rows, omega)

    def strokes(self, ratios: ArrayLike, frequencies_hz: ArrayLike) -> Tensor:
        """Return the stroke of each of ``DAMPERS`` for each input, metre per metre.

        Complex, (n_vehicles, n_inputs, 12, n_freq), [-], scaled as `channels`; in series with a
        bushing it is that of the damper alone. ValueError as of `channels`.
        """
        rows, omega = self._rows(ratios), self._bins(frequencies_hz)
        return strokes(self._layout, self._in_si, self.places, rows, omega, DAMPERS)

    def channels_along(
        self,
        ratios: ArrayLike,
        frequencies_hz: ArrayLike,
        directions: ArrayLike,
    ) -> tuple[Tensor, Tensor]:
        """Return `channels` and their derivatives along directions of the columns' logarithms.

        `directions` (n_directions, n_columns) are changes of the logarithms of all ``columns`` (of
        1 + ratio for those that may be absent). The derivatives have the shape
        (n_vehicles, n_directions, n_inputs, n_sensors, n_freq), [-].
        """
        rows, omega = self._rows(ratios), self._bins(frequencies_hz)
        along = as_tensor(directions).to(self.device, torch.float64)
        if along.ndim != 2 or along.shape[1] != len(self.columns):
            raise ValueError(
                f"`directions` must have shape (n_directions, {len(self.columns)}), got "
                f"{tuple(along.shape)}"
            )
        used = (along != 0).any(dim=0)
        channels, slopes = [], []
        for row in rows:
            sizes = torch.where(used, row + self.offsets.to(rows), 0.0)
            response, by_column = derivatives(
                self._layout, self._in_si, self.places, row, omega, sizes
            )
            channels.append(response)
            slopes.append(torch.tensordot(along[:, sizes != 0].to(response), by_column, 1))
        return torch.stack(channels), torch.stack(slopes)

    def motion_system(self, ratios: ArrayLike) -> LinearSystem:
        """Return the equations of motion of one vehicle, its ratios (13,), (14,) or all columns.

        The inputs are the height of the track under wheelsets 1 to 4 [m], its angle [rad] and, if
        `inputs` has it, its alignment [m]; the outputs are the sensors. Sensitivity and delay of
        sensors, and what excites single wheelsets, are no part of it.
        """
        return spatial_motion(self._layout, self._numbers(as_tensor(ratios)[None]), self.places)

    def _bins(self, frequencies_hz: ArrayLike) -> Tensor:
        omega = angular(frequencies_hz, self.device)
        if not bool((omega > 0).all()):
            raise ValueError("`frequencies_hz` must be positive")
        return omega

    def _measured(self, p: Mapping[str, Tensor]) -> dict[str, Tensor]:
        measured = {
            name: p[name] * p[f"healthy_{name}"] * p[f"healthy_{name[:3]}"]
            for name in COMPONENTS[:-1]
        }
        other = {
            f"other_{name}": p[f"other_{name}"] * p[f"other_{name[:3]}"] for name in COMPONENTS[:-1]
        }
        return measured | other
