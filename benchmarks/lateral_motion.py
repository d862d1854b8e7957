"""Which lateral and elastic motion the pairs need: a vehicle with all of it, read without some.

    python benchmarks/lateral_motion.py --vehicles 12

Vehicles drawn from the prior, one of twelve parts at 70 %, six sensors, 34 dB. For each part of the
family that is left out: the change of the responses to mean and cross level, relative to the rms of
each (sum and half difference of a pair); the power in the sensors that no input spectra explain,
over that of the noise (1 is no more than the noise), before and after the fit; and the errors of
the twelve parts and the mass, rms in %, that fitting the subspace of the responses makes of it with
the inputs' spectra free. With --free, all other uncertain numbers are fitted too, under their
priors about the truth, else they are known.
"""

from __future__ import annotations

from argparse import ArgumentParser
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from suspnet.cli.kinds import read_vehicles
from suspnet.ground.parameters import COMPONENTS
from suspnet.vehicle.quantities import ADDITIONS
from suspnet.vehicle.spatial_vehicle import SpatialVehicle
from suspnet.vehicle.track import acceleration_density, track_spectrum

BASE = ("bushings", "rubber", "guidance", "longitudinal", "bending", "roll")
SWAY_AND_YAW = ("frame_sway", "frame_yaw", "body_yaw")
LEFT_OUT = {
    "nothing": (),
    **{part: (part,) for part in ADDITIONS},
    "sway, yaw": SWAY_AND_YAW,
    "sway, yaw, creep": (*SWAY_AND_YAW, "creep"),
    "all": tuple(ADDITIONS),
}
FREQUENCIES = torch.linspace(0.5, 20.0, 100, dtype=torch.float64)
SPEED, NOISE, WORN, N_AVERAGES, STEPS = 70.0, 10 ** (-34 / 20), 0.7, 110, 20
KINDS = {"k_p": slice(0, 8, 2), "c_p": slice(1, 8, 2), "k_s": [8, 10], "c_s": [9, 11], "M_s": [12]}


def rms(values: Tensor) -> Tensor:
    """Return the rms over places and frequencies of each vehicle."""
    return values.abs().square().mean(dim=(1, 2)).sqrt()


def change(found: Tensor, expected: Tensor, of: int) -> float:
    """Return the change of the differences of frame and body for an input, over their rms [%]."""
    first, second = ((one[:, of, 2::2] - one[:, of, 3::2]) / 2 for one in (found, expected))
    return 100 * float((rms(first - second) / rms(second)).median())


def power(expected: Tensor) -> tuple[Tensor, Tensor]:
    """Return A D^1/2 of the vehicles in units of the noise, and the noise of each sensor."""
    density = acceleration_density(track_spectrum("german_low"), FREQUENCIES.numpy(), SPEED)
    signal = expected * torch.as_tensor(density).sqrt()
    noise = NOISE * signal.abs().square().sum(dim=1).mean(dim=-1, keepdim=True).sqrt()
    return (signal / noise[:, None]).permute(0, 3, 2, 1), noise


def fitted(
    model: SpatialVehicle, columns: Tensor, signal: Tensor, noise: Tensor, free: bool
) -> tuple[Tensor, list[float]]:
    """Return the errors of the outputs [%], and the misfit before and after the fit."""
    n, rows = len(COMPONENTS), columns.clone()
    along = torch.eye(len(model.columns), dtype=torch.float64)[:n]
    if free:
        widths = torch.zeros(len(model.columns), dtype=torch.float64)
        widths[model.uncertain_columns] = torch.as_tensor(model.distribution.deviations)
        along = torch.cat([along, torch.diag(widths)[model.uncertain_columns]])
    numbers = torch.arange(len(along)) >= n
    best = rows.new_full((len(rows),), torch.inf)
    damping, misfits = torch.ones_like(best), []
    at = kept = rows.new_zeros(len(rows), len(along))
    for _ in range(STEPS):
        rows = (columns + model.offsets) * (at @ along).exp() - model.offsets
        channels, slopes = model.channels_along(rows, FREQUENCIES, along)
        a = (channels / noise[:, None]).permute(0, 3, 2, 1)
        da = (slopes / noise[:, None, None]).permute(0, 1, 4, 3, 2)
        q, _ = torch.linalg.qr(a)
        residual = signal - q @ (q.mH @ signal)
        square = residual.abs().square().sum(dim=(2, 3)).mean(dim=1)
        # the projector's derivative without the term that vanishes with the residual
        turned = da @ (torch.linalg.pinv(a) @ signal)[:, None]
        turned = turned - q[:, None] @ (q[:, None].mH @ turned)
        jacobian = torch.view_as_real(turned).flatten(2)
        gradient = jacobian @ torch.view_as_real(residual).flatten(1)[..., None]
        normal = jacobian @ jacobian.mT + torch.diag(numbers / N_AVERAGES)
        slope = gradient[..., 0] - numbers / N_AVERAGES * at
        cost = len(FREQUENCIES) * square + (at * numbers).square().sum(dim=1) / N_AVERAGES
        if not misfits:
            solved = normal, slope, square
        better = cost < best
        best, kept = torch.where(better, cost, best), torch.where(better[:, None], at, kept)
        pairs = zip((normal, slope, square), solved, strict=True)
        solved = tuple(torch.where(better.view(-1, *[1] * (x.ndim - 1)), x, y) for x, y in pairs)
        damping = torch.where(better, damping / 10, damping * 10)
        misfits.append(1 + float((solved[2] / (a.shape[2] - a.shape[3])).median()))
        diagonal = torch.diag_embed(solved[0].diagonal(dim1=1, dim2=2) * damping[:, None])
        at = kept + torch.linalg.solve(solved[0] + diagonal, solved[1]).clamp(-1, 1)
    rows = (columns + model.offsets) * (kept @ along).exp() - model.offsets
    return 100 * (rows[:, :n] / columns[:, :n] - 1), [misfits[0], misfits[-1]]


def main() -> None:
    """Print the table."""
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vehicles", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--free", action="store_true")
    given = parser.parse_args()
    am96, parts = read_vehicles()["am96"], (*BASE, *ADDITIONS)
    full = SpatialVehicle(am96, speed_m_per_s=SPEED, parts=parts, distribution="prior")
    ratios = torch.ones(given.vehicles, len(COMPONENTS), dtype=torch.float64)
    ratios[np.arange(given.vehicles), np.arange(given.vehicles) % 12] = WORN
    columns = full.sample_unmeasured(ratios, given.seed)
    expected = full.channels(columns, FREQUENCIES)
    signal, noise = power(expected)
    size = rms(expected[:, 2, 2:]) / rms(expected[:, 1, 2:])
    print(f"response to alignment over that to cross level: {100 * float(size.median()):.0f} %")
    titles = ["left out", "mean to difference, %", "cross level, %", "misfit", "fitted", *KINDS]
    print("", *titles, "", sep=" | ")
    print("|---" * len(titles) + "|")
    for name, missing in LEFT_OUT.items():
        model = replace(full, parts=tuple(part for part in parts if part not in missing))
        found = model.channels(columns, FREQUENCIES)
        errors, misfits = fitted(model, columns, signal, noise, given.free)
        numbers = [change(found, expected, 0), change(found, expected, 1), *misfits]
        numbers += [float(errors[:, one].square().mean().sqrt()) for one in KINDS.values()]
        print("", name, *(f"{number:.2g}" for number in numbers), "", sep=" | ")


if __name__ == "__main__":
    main()
