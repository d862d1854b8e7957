"""TensorBoard: scalars of each iteration, hyperparameters, figures, the configuration as text."""

import io
import json
from collections.abc import Collection, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from suspnet.ground.storage import write_atomically

HYPERPARAMETERS: dict[str, Any] = {
    **dict.fromkeys(("model", "group", "feature_map", "protocol", "vehicle"), ""),
    **dict.fromkeys(("C", "sigma", "epsilon", "length_scale", "snr_db"), 0.0),
    **dict.fromkeys(("signal_variance", "noise_variance"), 0.0),
    **dict.fromkeys(("n_components", "n_train", "seed"), 0),
}
"""Columns of the HPARAMS tab, each with a value of its type."""
OF_EVERY_METHOD = ("model", "group", "n_train", "snr_db", "seed", "protocol", "vehicle")
"""Columns that a run of any method fills."""
SHOWN_FIRST = ("model", "group", "C", "sigma", "epsilon")
"""Hyperparameters that the table shows of a run that is no job of a multirun."""
SECTIONS = {"comparison": ("table6", "tube"), "estimates": ("parity",), "training": ("peaks",)}
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


class RunLog(AbstractContextManager["RunLog"]):
    """One run's TensorBoard events, in the run's own folder; a context manager.

    If `is_new`, TensorBoard shows these events in place of those that an earlier run left in the
    folder, whose file stays.
    """

    def __init__(self, folder: Path, is_new: bool = False) -> None:
        self._writer = SummaryWriter(str(folder), purge_step=0 if is_new else None)

    def __exit__(self, *_: object) -> None:
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

    def hyperparameters(
        self,
        values: Mapping[str, Any],
        metrics: Mapping[str, float],
        columns: Collection[str],
        swept: Collection[str] = (),
    ) -> None:
        """Write hyperparameters and final metrics for the HPARAMS tab.

        `columns` are the metrics that every run of a multirun has: the parallel coordinates leave
        out a run without one of them, or without a hyperparameter that is shown. `swept` are the
        hyperparameters in which its runs differ.

        `SummaryWriter.add_hparams` would create a folder of its own below the run's; these
        summaries go into the run's own file, so that a run is one row of the table and one line of
        the parallel coordinates. TensorBoard takes the columns from whichever run it meets first,
        so every run of a multirun declares the same ones. It shows those declared to differ, in
        alphabetical order.
        """
        finals = {f"final/{name}": 0.0 for name in columns}
        names = OF_EVERY_METHOD if "model" in swept else HYPERPARAMETERS
        known = {key: HYPERPARAMETERS[key] for key in names}
        known |= {key: values[key] for key in swept if _is_plain(values.get(key))}
        experiment, _, end = hparams(known, finals)
        content = experiment.value[0].metadata.plugin_data
        declared = HParamsPluginData.FromString(content.content)
        for info in declared.experiment.hparam_infos:
            info.differs = info.name in (swept or SHOWN_FIRST)
        content.content = declared.SerializeToString()
        used = {k: v for k, v in values.items() if k in known and _is_plain(v)}
        _, start, _ = hparams(used, finals)
        for summary in (experiment, start, end):
            self._writer._get_file_writer().add_summary(summary)
        self.scalars("final", metrics, 0)


def _is_plain(value: Any) -> bool:
    return isinstance(value, bool | int | float | str)
