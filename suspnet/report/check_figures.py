"""The picture of one trip: its channels and speed, their spectra, and the coherence."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from suspnet.ground.storage import write_atomically
from suspnet.recordings.recording import Recording, overview
from suspnet.report.figures import CHANNEL_TITLES, draw_signals, say
from suspnet.spectra.cross_spectra import CrossSpectra

LINKS = ("axle box to bogie frame", "bogie frame to car body")
DPI = 110


def trip_figure(
    recording: Recording,
    frequencies_hz: Tensor,
    spectra: CrossSpectra | None,
    band_hz: tuple[float, float],
) -> Figure:
    """Signals and speed of a recording in windows; spectra and coherence with the vehicle's band.

    Parameters
    ----------
    recording : Recording
    frequencies_hz : tensor of shape (n_freq,), [Hz]
    spectra : CrossSpectra, optional
        Of shape (3, n_freq); None if no stretch is free of faults.
    band_hz : pair of float, [Hz]
    """
    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    columns: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
    left, right = columns
    axes: list[Axes] = list(left.subplots(4, 1, sharex=True))
    draw_signals(axes, overview(recording))
    left.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    left.align_ylabels(axes)
    upper, lower = right.subplots(2, 1, sharex=True)
    upper.set(ylabel="power density [(m/s²)²/Hz]", title="spectra")
    lower.set(ylabel="coherence", title="coherence", xlabel="frequency [Hz]", ylim=(0, 1.05))
    if spectra is None:
        for axis in (upper, lower):
            say(axis, "no stretch is long enough and free of faults")
        return figure
    hertz = frequencies_hz.numpy()
    for title, density in zip(CHANNEL_TITLES, spectra.auto.numpy(), strict=True):
        upper.semilogy(hertz[1:], np.where(density > 0, density, np.nan)[1:], label=title, lw=1)
    for title, coherence in zip(LINKS, spectra.coherences().numpy(), strict=True):
        lower.plot(hertz[1:], coherence[1:], label=title, lw=1)
    for axis, place in ((upper, "lower left"), (lower, "lower right")):
        axis.axvspan(*band_hz, color="tab:green", alpha=0.08, lw=0, label="vehicle's band")
        axis.margins(x=0)
        axis.grid(True, which="major", alpha=0.3)
        axis.legend(loc=place, fontsize="small")
    return figure


def write_picture(path: Path, figure: Figure, title: str) -> None:
    """Write a figure as PNG, whole or not at all; OSError if the folder cannot be written."""
    figure.suptitle(title, fontsize="medium")
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=DPI)
    write_atomically(path, stream.getvalue())
