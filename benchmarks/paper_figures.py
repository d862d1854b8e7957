"""Figures 3, 5, 7 and 11 of the paper; each function returns a new Figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullFormatter

from suspnet.ground.parameters import PARAMETERS, UNITS
from suspnet.ground.types import FloatArray
from suspnet.runs.figures import SUSPENSIONS, SYMBOLS
from suspnet.runs.plots import BOUND_COLOUR, PEAKS, draw_peaks, grid
from suspnet.runs.tables import MODEL_TITLES
from suspnet.vehicle import ResponseGenerator, Vehicle

PRECISION_TICKS = (0.2, 0.5, 1, 2, 5)


def quarter_car(vehicle: Vehicle) -> Figure:
    """Draw the model of a vehicle, with its parameters: masses, springs and dampers (Fig. 3)."""
    figure, ((axis,),) = grid(1, 1, size=(5.6, 5.6))
    values = dict(zip(PARAMETERS, vehicle.healthy_values(), strict=True))
    values["M_p"] = vehicle.bogie_mass_kg
    shown = {
        name: f"${name}$\n{value:,.0f} {UNITS.get(name, 'kg')}" for name, value in values.items()
    }
    for y, name, mass, motion in ((2.6, "car body", "M_s", "z_s"), (1.0, "bogie", "M_p", "z_p")):
        axis.add_patch(Rectangle((0, y), 2, 0.6, facecolor="0.88", edgecolor="black"))
        axis.text(1, y + 0.3, f"{name} {shown[mass]}", ha="center", va="center")
        _motion(axis, y + 0.3, motion)
    for low, spring, damper in ((0.0, "k_p", "c_p"), (1.6, "k_s", "c_s")):
        _spring(axis, 0.45, low, low + 1)
        _damper(axis, 1.55, low, low + 1)
        axis.text(0.2, low + 0.5, shown[spring], ha="right", va="center")
        axis.text(1.85, low + 0.5, shown[damper], ha="left", va="center")
    axis.plot([0.0, 2.0], [0.0, 0.0], color="black", lw=3)
    axis.text(1.0, -0.12, "wheelset", ha="center", va="top")
    _motion(axis, 0.0, "w")
    axis.set(xlim=(-1.4, 3.4), ylim=(-0.4, 3.4), aspect="equal")
    axis.axis("off")
    return figure


def _motion(axis: Axes, y: float, symbol: str) -> None:
    """Draw a coordinate, positive upwards."""
    arrow = {"arrowstyle": "->", "color": "tab:blue", "lw": 1.5}
    axis.annotate("", (2.15, y + 0.25), (2.15, y - 0.1), arrowprops=arrow)
    axis.text(2.25, y, f"${symbol}$", color="tab:blue", va="center")


def _spring(axis: Axes, x: float, low: float, high: float) -> None:
    zigzag = np.array([0, 0, -1, 1, -1, 1, -1, 1, 0, 0])
    heights = np.r_[low, np.linspace(low + 0.15, high - 0.15, 8), high]
    axis.plot(x + 0.14 * zigzag, heights, color="black", lw=1.5)


def _damper(axis: Axes, x: float, low: float, high: float) -> None:
    bottom, piston, top = low + 0.3, low + 0.5, low + 0.7
    axis.plot([x, x], [low, bottom], color="black", lw=1.5)
    pot = [x - 0.16, x - 0.16, x + 0.16, x + 0.16]
    axis.plot(pot, [top, bottom, bottom, top], color="black", lw=1.5)
    axis.plot([x - 0.12, x + 0.12], [piston, piston], color="black", lw=3)
    axis.plot([x, x], [piston, high], color="black", lw=1.5)


def bode(generator: ResponseGenerator, frequencies_hz: torch.Tensor) -> Figure:
    """Draw magnitude and phase of both responses of the healthy vehicle (Fig. 5)."""
    responses = generator.responses(torch.ones(1, len(PARAMETERS)), frequencies_hz)
    figure, axes = grid(2, 2, sharex=True)
    frequencies = frequencies_hz.cpu().numpy()
    for column, (title, response) in enumerate(zip(SUSPENSIONS, responses, strict=True)):
        values = response[0].cpu().numpy()
        upper, lower = axes[0][column], axes[1][column]
        upper.semilogx(frequencies, 20 * np.log10(np.abs(values)))
        upper.set(title=title, ylabel="magnitude [dB]")
        lower.semilogx(frequencies, np.degrees(np.unwrap(np.angle(values))))
        lower.set(xlabel="frequency [Hz]", ylabel="phase [degrees]")
    return figure


def degradation(generator: ResponseGenerator, frequencies_hz: torch.Tensor) -> Figure:
    """Draw the magnitudes when each parameter halves or doubles, the others healthy (Fig. 7)."""
    frequencies = frequencies_hz.cpu().numpy()
    figure, axes = grid(2, len(PARAMETERS), size=(3.0, 2.7), sharex=True)
    for column, name in enumerate(PARAMETERS):
        for ratio, colour in ((0.5, "tab:blue"), (1.0, "0.3"), (2.0, "tab:red")):
            ratios = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
            ratios[0, column] = ratio
            curves = generator.magnitudes(ratios, frequencies_hz)[0].cpu().numpy()
            for row, curve in enumerate(curves):
                axes[row][column].plot(frequencies, curve, color=colour, label=f"{ratio:.0%}")
        axes[0][column].set_title(f"{SYMBOLS[name]} varies")
        axes[1][column].set_xlabel("frequency [Hz]")
    for row, title in enumerate(SUSPENSIONS):
        axes[row][0].set_ylabel(f"magnitude\n{title}")
        for axis in axes[row]:
            axis.set_xlim(0, 10)
    axes[0][0].legend()
    return figure


def sensitivity(runs: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the MAPE of each model's outputs against sensor precision, with their bounds (Fig. 11).

    Thin lines are the paper's claim: less than 10 % where the precision is better than 2 %.
    """
    models = list(dict.fromkeys(run["model"] for run in runs))
    figure, axes = grid(1, len(models), size=(6.4, 4.4), sharey=True)
    for axis, model in zip(axes[0], models, strict=True):
        own = sorted((r for r in runs if r["model"] == model), key=lambda run: run["snr_db"])
        for output in dict.fromkeys(name for run in own for name in run["scores"]):
            chosen = [r for r in own if output in r["scores"]]
            precision = [100 * 10 ** (-run["snr_db"] / 20) for run in chosen]  # [%]
            mape, bound = (
                [run[key][output]["mape_percent"] for run in chosen] for key in ("scores", "bound")
            )
            (line,) = axis.loglog(precision, mape, "o-", label=SYMBOLS[output])
            axis.loglog(precision, bound, "--", color=line.get_color(), lw=1)
        axis.axhline(10, color="0.5", lw=0.8)
        axis.axvline(2, color="0.5", lw=0.8)
        axis.plot([], [], "--", color=BOUND_COLOUR, lw=1, label="Cramer-Rao bound")
        axis.set(title=MODEL_TITLES[model], xlabel="sensor precision [%]")
        axis.set_xticks(PRECISION_TICKS, [f"{tick:g}" for tick in PRECISION_TICKS])
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.yaxis.set_major_formatter("{x:g}")
    axes[0][0].set_ylabel("MAPE [%]")
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=5)
    return figure


def peak_fits(
    frequencies_hz: FloatArray, curves: FloatArray, features: Mapping[str, float]
) -> Figure:
    """Draw the peaks of both curves (Fig. 6)."""
    figure, axes = grid(1, 2)
    for axis, suspension, curve in zip(axes[0], PEAKS, curves, strict=True):
        draw_peaks(axis, frequencies_hz, curve, features, suspension)
    return figure
