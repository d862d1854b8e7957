"""TensorBoard: scalars of each iteration, hyperparameters, figures, the configuration as text."""

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
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from suspnet.ground.parameters import PARAMETERS
from suspnet.ground.storage import write_atomically
from suspnet.learning.metrics import METRICS

HYPERPARAMETERS: dict[str, Any] = {
    "model": "",
    "group": "",
    "C": 0.0,
    "sigma": 0.0,
    "epsilon": 0.0,
    "feature_map": "",
    "n_components": 0,
    "length_scale": 0.0,
    "signal_variance": 0.0,
    "noise_variance": 0.0,
    "n_train": 0,
    "snr_db": 0.0,
    "seed": 0,
    "protocol": "",
    "vehicle": "",
}
"""Columns of the HPARAMS tab, each with a value of its type."""
SHOWN_FIRST = ("model", "group", "C", "sigma", "epsilon")
METRIC_COLUMNS = (
    *(f"{metric}_{output}" for output in PARAMETERS for metric in METRICS),
    *(f"rms_ratio_{output}" for output in PARAMETERS),
    "cv_rmse",
    "seconds",
)
SECTIONS = {
    "comparison": ("table6", "tube"),
    "estimates": ("parity",),
    "training": ("peaks",),
}
"""Figures by the section they are shown in; TensorBoard shows sections in alphabetical order."""


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
        """Write the resolved configuration as an indented block."""
        lines = json.dumps(content, indent=2, default=str).splitlines()
        self.text("config", "\n".join(f"    {line}" for line in lines))

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

    def hyperparameters(self, values: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """Write hyperparameters and final metrics for the HPARAMS tab.

        `SummaryWriter.add_hparams` would create a folder of its own below the run's; these
        summaries go into the run's own file, so that a run is one row of the table and one line of
        the parallel coordinates. TensorBoard takes the columns from whichever run it meets first,
        so every run of a multirun declares the same columns and fills in those it has. TensorBoard
        shows the columns declared to differ first, in alphabetical order.
        """
        finals = {f"final/{name}": 0.0 for name in METRIC_COLUMNS}
        experiment, _, end = hparams(HYPERPARAMETERS, finals)
        content = experiment.value[0].metadata.plugin_data
        declared = HParamsPluginData.FromString(content.content)
        for info in declared.experiment.hparam_infos:
            info.differs = info.name in SHOWN_FIRST
        content.content = declared.SerializeToString()
        used = {k: v for k, v in values.items() if k in HYPERPARAMETERS and v is not None}
        _, start, _ = hparams(used, finals)
        for summary in (experiment, start, end):
            self._writer._get_file_writer().add_summary(summary)
        self.scalars("final", metrics, 0)
