"""TensorBoard: scalars of each iteration, hyperparameters, figures, the configuration as text."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from suspnet.dynamics import PARAMETERS
from suspnet.runs.metrics import METRICS
from suspnet.storage import write_atomically

HYPERPARAMETERS: dict[str, Any] = {
    "vehicle": "",
    "protocol": "",
    "group": "",
    "model": "",
    "seed": 0,
    "n_train": 0,
    "snr_db": 0.0,
    "feature_map": "",
    "n_components": 0,
    "C": 0.0,
    "sigma": 0.0,
    "epsilon": 0.0,
    "length_scale": 0.0,
    "signal_variance": 0.0,
    "noise_variance": 0.0,
}
"""Columns of the HPARAMS tab, each with a value of its type."""
METRIC_COLUMNS = (
    *(f"{metric}_{output}" for output in PARAMETERS for metric in METRICS),
    "cv_rmse",
    "seconds",
)


class RunLog:
    """One run's TensorBoard events, in the run's own folder; a context manager.

    Parameters
    ----------
    folder : Path
        Where the event file goes.
    """

    def __init__(self, folder: Path) -> None:
        self._writer = SummaryWriter(str(folder))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.close()

    def scalars(self, prefix: str, values: Mapping[str, float], step: int) -> None:
        """Write scalars named prefix/key."""
        for key, value in values.items():
            self._writer.add_scalar(f"{prefix}/{key}", value, step)

    def text(self, name: str, content: str) -> None:
        """Write text, shown as Markdown."""
        self._writer.add_text(name, content)

    def config(self, content: Mapping[str, Any]) -> None:
        """Write the resolved configuration as an indented block."""
        lines = json.dumps(content, indent=2, default=str).splitlines()
        self.text("config", "\n".join(f"    {line}" for line in lines))

    def figure(self, name: str, figure: Figure, folder: Path | None = None) -> None:
        """Write a figure as an image, and as folder/name.png if a folder is given."""
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        pixels = np.asarray(canvas.buffer_rgba())[:, :, :3]
        self._writer.add_image(name, pixels, dataformats="HWC")
        if folder is not None:
            stream = io.BytesIO()
            Image.fromarray(np.ascontiguousarray(pixels)).save(stream, "PNG")
            write_atomically(folder / f"{name}.png", stream.getvalue())

    def hyperparameters(self, values: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """Write hyperparameters and final metrics for the HPARAMS tab.

        `SummaryWriter.add_hparams` would open a folder of its own below the run's; these summaries
        go into the run's own file, so that a run is one row of the table and one line of the
        parallel coordinates. TensorBoard takes the columns from whichever run it meets first, so
        every run declares the same ones and fills in those it has.
        """
        shown = {k: v for k, v in values.items() if k in HYPERPARAMETERS and v is not None}
        columns = {f"final/{name}": 0.0 for name in METRIC_COLUMNS}
        experiment, _, end = hparams(dict(HYPERPARAMETERS), columns)
        _, start, _ = hparams(shown, columns)
        for summary in (experiment, start, end):
            self._writer._get_file_writer().add_summary(summary)
        self.scalars("final", metrics, 0)
