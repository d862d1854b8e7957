"""Frequency responses of a vehicle of twelve separate parts, and their derivatives.

With X the motion of the coordinates for the inputs, E the motion of the track under the wheelsets,
G the stretches of the elements (`suspnet.vehicle.spatial_motion`) and A their pulls, each element
adds its kappa to the dynamic stiffness Z and to the forces B of the inputs::

    (A^T kappa G - omega^2 M) (X, E) = 0,   that is  Z X = B,
    H = gamma (C X + D E)

with gamma the sensitivities of the sensors and C, D what they see. The derivative of H with respect
to numbers of the vehicle is that of

    f = gamma (A_0 (B - Z X_0) + C X_0 + D E) = gamma (C - A_0 (A^T kappa G - omega^2 M)) (X_0, E)

(C with D, and 0 under E for M), where X_0 and A_0 = C Z^-1 are held: Z X_0 is B where they belong,
and neither Z nor its inverse is differentiated. f is a sum of products of kappa, stretches, pulls,
masses, E, C, D and gamma: differences of these give its derivative by the product rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from suspnet.vehicle.spatial_motion import (
    Row,
    acting,
    by_axle,
    coordinates,
    is_lateral,
    masses,
    sensed,
    wheel_inputs,
)
from suspnet.vehicle.vertical_motion import RAIL_LATERAL_M, Element, Layout
from suspnet.vehicle.vertical_response import cross_level_size, phasor, root_of_size, wheels_of

STEP = 1e-7
"""Step of the differences of the equations, relative to a number; they err by 1e-7 or so."""
MOST_NUMBERS = 1 << 19
"""Complex numbers of the largest array at once; it takes 64 MB."""


@dataclass(frozen=True)
class MotionEquations:
    """Vehicles at some frequencies: their elements, masses, inputs and sensors.

    `kappa` (n_vehicles, n_elements, n_freq), of which stretch k has the element `element[k]`;
    `stretches` (n_vehicles, n_stretches, n_coordinates + n_wheel_inputs), `pulls` (n_vehicles,
    n_stretches, n_coordinates), `inertia` (n_vehicles, n_coordinates, n_freq) is omega^2 M,
    `inputs` (n_vehicles, n_freq, n_wheel_inputs, n_inputs) is E, `places` (n_vehicles, n_sensors,
    n_coordinates + n_wheel_inputs), `gains` (n_vehicles, n_sensors, n_freq), None if all are 1.
    """

    kappa: Tensor
    element: Tensor
    stretches: Tensor
    pulls: Tensor
    inertia: Tensor
    inputs: Tensor
    places: Tensor
    gains: Tensor | None

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.pulls.shape[2]

    def solved(self) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Return X (n_vehicles, n_freq, n_coordinates, n_inputs) and the factors of Z."""
        n_vehicles, n_elements, _ = self.kappa.shape
        squares = self.pulls[..., :, None] * self.stretches[..., None, :]
        # stretches of one element are added up first: kappa is the same for all of them
        summed = squares.new_zeros(n_vehicles, n_elements, *squares.shape[2:])
        summed = summed.index_add(1, self.element, squares).flatten(2)
        whole = torch.complex(self.kappa.real.mT @ summed, self.kappa.imag.mT @ summed)
        whole = whole.unflatten(2, squares.shape[2:])
        stiffness, below = whole[..., : self.n].contiguous(), whole[..., self.n :]
        stiffness.diagonal(dim1=2, dim2=3).sub_(self.inertia.mT)
        factors = torch.linalg.lu_factor(stiffness)
        return torch.linalg.lu_solve(*factors, -(below @ self.inputs)), tuple(factors)

    def adjoint(self, factors: tuple[Tensor, Tensor]) -> Tensor:
        """Return A_0 from the factors of Z, (n_vehicles, n_freq, n_sensors, n_coordinates)."""
        seen = self.places[:, None, :, : self.n].mT.to(factors[0].dtype)
        seen = seen.expand(-1, factors[0].shape[1], -1, -1)
        adjoint: Tensor = torch.linalg.lu_solve(*factors, seen, adjoint=True).mH
        return adjoint

    def measured(self, motion: Tensor) -> Tensor:
        """Return H of the motion X, (n_vehicles, n_inputs, n_sensors, n_freq)."""
        response = self._seen(motion).permute(0, 3, 2, 1)
        return response if self.gains is None else response * self.gains[:, None]

    def _seen(self, motion: Tensor) -> Tensor:
        """Return H without the sensors' gains, (n_vehicles, n_freq, n_sensors, n_inputs)."""
        places = self.places[:, None].to(motion.dtype)
        return places[..., : self.n] @ motion + places[..., self.n :] @ self.inputs

    def moved(self, changes: MotionEquations, motion: Tensor, adjoint: Tensor) -> Tensor:
        """Return the derivatives of H of one vehicle, its X and A_0 given.

        `changes` are the derivatives of its equations, one in each row; the result has the shape
        (n_rows, n_inputs, n_sensors, n_freq).
        """
        n, whole = self.n, torch.cat([motion, self.inputs], dim=2)[0]
        seen = adjoint[0]  # (n_freq, n_sensors, n)
        kappa = self.kappa[0, self.element, :, None]
        # all that follows has stretches, elements or numbers first, then n_freq
        stretched = (self.stretches[0].to(whole.dtype) @ whole).transpose(0, 1)
        pulled = (seen @ self.pulls[0].T.to(seen.dtype)).permute(2, 0, 1)
        n_freq, n_sensors, n_inputs = len(seen), seen.shape[1], whole.shape[2]
        shape = n_freq, n_sensors, n_inputs
        # what each element and each mass does to each sensor for each input
        squares = pulled[..., None] * stretched[:, :, None]
        elements = squares.new_zeros(self.kappa.shape[1], *shape)
        elements = elements.index_add(0, self.element, squares)
        moving, moved = seen.permute(2, 0, 1), motion[0].transpose(0, 1)
        change = squares.new_zeros(len(changes.kappa), *shape)
        # a number changes few of the elements and masses: only those are taken
        row, k = _changed(changes.kappa)
        change.index_add_(0, row, changes.kappa[row, k, :, None, None] * elements[k])
        row, k = _changed(changes.inertia)
        inertia = changes.inertia[row, k, :, None] * moving[k]
        change.index_add_(0, row, inertia[..., None] * -moved[k, :, None])
        # few factors of the coordinates depend on a number: only those are taken
        k, i = _changing(changes.pulls)
        factors = changes.pulls[:, k, i]
        weights = moving[i, :, :, None] * (kappa * stretched)[k, :, None]
        k, i = _changing(changes.stretches)
        factors = torch.cat([factors, changes.stretches[:, k, i]], dim=1)
        loads = (kappa * pulled)[k, ..., None] * whole.transpose(0, 1)[i, :, None]
        weights = torch.view_as_real(torch.cat([weights, loads])).flatten(1)
        change = -(change + torch.view_as_complex((factors @ weights).view(-1, *shape, 2)))
        rows = _moving(changes.places)
        change[rows] += changes.places[rows, None].to(whole.dtype) @ whole
        rows = _moving(changes.inputs)
        loads = (kappa * pulled).permute(1, 2, 0)
        below = self.places[0, :, n:] - loads @ self.stretches[0, :, n:].to(whole.dtype)
        change[rows] += below @ changes.inputs[rows]
        slopes: Tensor = change.permute(0, 3, 2, 1)
        if self.gains is not None and changes.gains is not None:
            without = self._seen(motion).permute(0, 3, 2, 1)
            slopes = slopes * self.gains[:, None] + without * changes.gains[:, None]
        return slopes

    def of(self, vehicles: slice) -> MotionEquations:
        """Return the equations of some of the vehicles."""
        return replace(self, **{k: v[vehicles] for k, v in self._by_vehicle().items()})

    def minus(self, other: MotionEquations, size: float) -> MotionEquations:
        """Return the difference of two equations over a size."""
        theirs = other._by_vehicle()
        differences = {
            name: (values - theirs[name]) / size for name, values in self._by_vehicle().items()
        }
        return replace(self, **differences)

    def _by_vehicle(self) -> dict[str, Tensor]:
        """Return all fields but `element`, and but `gains` if these are all 1."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {k: v for k, v in values.items() if k != "element" and v is not None}


def _changing(factors: Tensor) -> tuple[Tensor, ...]:
    """Return the places of (n_rows, n_stretches, n) at which a row is not 0."""
    return (factors != 0).any(dim=0).nonzero(as_tuple=True)


def _changed(values: Tensor) -> tuple[Tensor, ...]:
    """Return rows and elements of (n_rows, n_elements, n_freq) that are not 0 at a frequency."""
    return (values != 0).any(dim=2).nonzero(as_tuple=True)


def _moving(values: Tensor) -> Tensor:
    """Return the numbers of the rows that are not 0."""
    return (values != 0).flatten(1).any(dim=1).nonzero()[:, 0]


def equations(
    layout: Layout, p: Mapping[str, Tensor], sensors: Sequence[str], omega: Tensor
) -> MotionEquations:
    """Return the equations of vehicles whose numbers `p` have the shape (n_vehicles, 1)."""
    parts = layout.parts
    moving, wheels = coordinates(layout), wheel_inputs(parts)
    joints = acting(layout, p)
    elements = {id(joint.element): joint.element for joint in joints}
    place = {key: i for i, key in enumerate(elements)}
    kappa = Element.stacked(list(elements.values())).at(omega)
    inertia = torch.stack(masses(layout, p), dim=1) * omega**2
    like = p["speed"]
    pulls = [joint.stretch if joint.pull is None else joint.pull for joint in joints]
    return MotionEquations(
        kappa=kappa,
        element=torch.tensor([place[id(joint.element)] for joint in joints], device=omega.device),
        stretches=_matrix([joint.stretch for joint in joints], (*moving, *wheels), like),
        pulls=_matrix(pulls, moving, like),
        inertia=inertia,
        inputs=_inputs(layout, p, omega).permute(0, 3, 1, 2),
        places=_matrix(sensed(layout, p, sensors), (*moving, *wheels), like),
        gains=_gains(p, sensors, omega) if "sensors" in parts else None,
    )


def _matrix(rows: Sequence[Row], names: Sequence[str], like: Tensor) -> Tensor:
    """Return factors of the coordinates `names`, (n_vehicles, n_rows, n_names); others are held."""
    column = {name: i for i, name in enumerate(names)}
    constants = [0.0] * (len(rows) * len(names))
    # many factors are the same tensor: each is taken once
    values: dict[int, Tensor] = {}
    order, where = [], []
    for i, row in enumerate(rows):
        for name, value in row.items():
            if name not in column:
                continue
            place = i * len(names) + column[name]
            if isinstance(value, Tensor):
                values.setdefault(id(value), value)
                order.append(id(value))
                where.append(place)
            else:
                constants[place] = value
    flat = like.new_tensor(constants).expand(len(like), -1)
    if values:
        number = {key: j for j, key in enumerate(values)}
        chosen = torch.tensor([number[key] for key in order], device=like.device)
        places = torch.tensor(where, device=like.device)
        distinct = torch.cat(list(values.values()), dim=1)
        flat = flat.index_copy(1, places, distinct[:, chosen])
    return flat.reshape(len(like), len(rows), len(names))


def input_names(parts: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the inputs of a vehicle with these parts."""
    track = ("mean", "cross_level", *(["alignment"] if is_lateral(parts) else []))
    if "wheelsets" not in parts:
        return track
    alone = (f"wheelset{wheel}{kind}" for kind in ("", "_roll") for wheel in range(1, 5))
    return (*track, *alone)


def _inputs(layout: Layout, p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
    """Return height, angle and lateral place under each wheelset for each input.

    Each input has the density of the mean; shape (n_vehicles, n_wheel_inputs, n_inputs, n_freq).
    """
    parts = layout.parts
    delayed = torch.stack(by_axle(layout, wheels_of(layout, p, omega)), dim=1)
    sizes = _sizes(layout, p, omega)
    kinds = torch.eye(sizes.shape[1], dtype=sizes.dtype, device=sizes.device)
    of_kind = sizes[:, :, None] * kinds[..., None]
    common = (delayed[:, None, :, None] * of_kind[:, :, None]).flatten(1, 2)
    if "wheelsets" not in parts:
        return common
    shares = root_of_size(p["wheelset_share"]), root_of_size(p["wheelset_roll_share"])
    alone = torch.cat([shares[0].expand(-1, 4), shares[1].expand(-1, 4) / RAIL_LATERAL_M], dim=1)
    alone = torch.diag_embed(alone)[..., None].expand(-1, -1, -1, len(omega))
    if is_lateral(parts):
        alone = torch.cat([alone, torch.zeros_like(alone[:, :4])], dim=1)
    return torch.cat([common, alone.to(common.dtype)], dim=2)


def _sizes(layout: Layout, p: Mapping[str, Tensor], omega: Tensor) -> Tensor:
    """Return height, angle and lateral place of the track for each input, (n_vehicles, k, n_freq).

    The roots of the inputs' densities over the mean's.
    """
    unit = torch.ones_like(p["speed"] * omega)
    sizes = [unit, cross_level_size(p, omega) / RAIL_LATERAL_M]
    if is_lateral(layout.parts):
        sizes.append(p["alignment"].sqrt() * unit)
    return torch.stack(sizes, dim=1)


def _gains(p: Mapping[str, Tensor], sensors: Sequence[str], omega: Tensor) -> Tensor:
    """Return sensitivity and delay of sensors, relative to the first one."""
    gains = [phasor(omega * p[f"delay_{name}"]) * p[f"gain_{name}"] for name in sensors[1:]]
    return torch.stack([torch.ones_like(gains[0]), *gains], dim=1)


Numbers = Callable[[Tensor], dict[str, Tensor]]
"""Numbers of vehicles, each (n_vehicles, 1), from columns (n_vehicles, n_columns)."""


def responses(
    layout: Layout, numbers: Numbers, sensors: Sequence[str], columns: Tensor, omega: Tensor
) -> Tensor:
    """Return H of vehicles, (n_vehicles, n_inputs, n_sensors, n_freq)."""
    blocks = []
    for rows in columns.split(_n_at_once(layout, omega)):
        system = equations(layout, numbers(rows), sensors, omega)
        blocks.append(system.measured(system.solved()[0]))
    return torch.cat(blocks)


def alone_responses(
    layout: Layout, numbers: Numbers, sensors: Sequence[str], columns: Tensor, omega: Tensor
) -> Tensor:
    """Return the responses to each input under one wheelset alone.

    Shape (n_vehicles, n_kinds, 4, n_sensors, n_freq), the wheelsets 1 to 4.
    """
    blocks = []
    for rows in columns.split(_n_at_once(layout, omega)):
        p = numbers(rows)
        sizes = _sizes(layout, p, omega).repeat_interleave(4, dim=1)
        inputs = torch.diag_embed(sizes.mT).to(torch.complex128)
        system = replace(equations(layout, p, sensors, omega), inputs=inputs)
        blocks.append(system.measured(system.solved()[0]).unflatten(1, (-1, 4)))
    return torch.cat(blocks)


def strokes(
    layout: Layout,
    numbers: Numbers,
    sensors: Sequence[str],
    columns: Tensor,
    omega: Tensor,
    dampers: Sequence[str],
) -> Tensor:
    """Return the strokes of named dampers, (n_vehicles, n_inputs, n_dampers, n_freq)."""
    p = numbers(columns)
    system = equations(layout, p, sensors, omega)
    whole = torch.cat([system.solved()[0], system.inputs], dim=2)
    joints = acting(layout, p)
    rows = [[joint.damper for joint in joints].index(name) for name in dampers]
    shares = torch.stack([joints[i].element.of_damper(omega) for i in rows], dim=1)
    stretched = system.stretches[:, None, rows].to(whole.dtype) @ whole
    return stretched.permute(0, 3, 2, 1) * shares[:, None]


def derivatives(
    layout: Layout,
    numbers: Numbers,
    sensors: Sequence[str],
    columns: Tensor,
    omega: Tensor,
    sizes: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return H of one vehicle and its derivatives with respect to its columns.

    `columns` (n_columns,); `sizes` (n_columns,) are the units in which each is changed, and those
    of 0 are left out of the derivatives (n_derivatives, n_inputs, n_sensors, n_freq).
    """
    steps = STEP * torch.diag(sizes)[sizes != 0]
    n_rows = MOST_NUMBERS // (len(coordinates(layout)) * len(omega))
    slopes: list[Tensor] = []
    for some in steps.split(max(1, n_rows // 2)):
        # one call for the vehicle and its changes, as one for few rows takes as long as for many
        rows = torch.cat([columns[None], columns + some])
        systems = equations(layout, numbers(rows), sensors, omega)
        if not slopes:
            system = systems.of(slice(1))
            motion, factors = system.solved()
            adjoint = system.adjoint(factors)
        changes = systems.of(slice(1, None)).minus(system, STEP)
        slopes.append(system.moved(changes, motion, adjoint))
    return system.measured(motion)[0], torch.cat(slopes)


def _n_at_once(layout: Layout, omega: Tensor) -> int:
    n = len(coordinates(layout))
    return max(1, MOST_NUMBERS // (len(omega) * n * (n + len(wheel_inputs(layout.parts)))))
