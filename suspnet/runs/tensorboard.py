"""TensorBoard: scalars of each iteration, final scores, figures, the configuration as text."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from suspnet.ground.storage import write_atomically

SECTIONS = {
    "comparison": ("table6", "tube"),
    "estimates": ("parity",),
    "training": ("peaks",),
}
"""Figures by the section they are shown in; TensorBoard shows sections in alphabetical order."""
ERROR_BY_N = "error_by_n"
"""Prefix of the rms error of each output, the step of which is a number of training curves."""
CHARTS = {
    "this run": {
        "rms error [%] by training curves": ["Multiline", [f"{ERROR_BY_N}/.*"]],
        "objective by iteration": ["Multiline", [r"\w+/objective"]],
        "cross-validated RMSE by trial": ["Multiline", ["search/.*"]],
    }
}
"""Layout of the tab CUSTOM SCALARS: the outputs of a run share one chart."""


class RunLog:
    """One run's TensorBoard events, in the run's own folder; a context manager.

    If `is_new`, TensorBoard shows these events in place of those that an earlier run left in the
    folder, whose file stays.
    """

    def __init__(self, folder: Path, is_new: bool = False) -> None:
        self._writer = SummaryWriter(str(folder), purge_step=0 if is_new else None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write the remaining events."""
        self._writer.close()

    def scalars(self, prefix: str, values: Mapping[str, float], step: int) -> None:
        """Write scalars named prefix/key."""
        for key, value in values.items():
            self._writer.add_scalar(f"{prefix}/{key}", value, step)

    def text(self, name: str, content: str) -> None:
        """Write text, shown as Markdown."""
        self._writer.add_text(name, content)

    def config(self, content: Mapping[str, Any]) -> None:
        """Write the resolved configuration as an indented block, and the layout of the charts.

        TensorBoard shows texts in alphabetical order: the scores before the settings.
        """
        self._writer.add_custom_scalars(CHARTS)
        lines = json.dumps(content, indent=2, default=str).splitlines()
        self.text("settings", "\n".join(f"    {line}" for line in lines))

    def figure(self, name: str, figure: Figure, folder: Path | None = None) -> None:
        """Write a figure as an image, and as folder/name.png if a folder is given."""
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        figure.set_layout_engine("none")  # it is laid out; once more would double the time
        pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
        sections = [f"{s}/{name}" for s, names in SECTIONS.items() if name.startswith(names)]
        self._writer.add_image([*sections, name][0], pixels, dataformats="HWC")
        if folder is not None:
            stream = io.BytesIO()
            Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "PNG")
            write_atomically(folder / f"{name}.png", stream.getvalue())
