"""The picture of README: from the signals of a trip to the trend of a worn part and its limits.

python tests/benchmarks/overview_picture.py outputs/evaluate/RUN

RUN is an evaluation of simulated trips, as README's demonstration leaves it. Letters are large and
rows below each other, so that a phone can show it; the background is opaque, for dark pages.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml
from cells import Parser
from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure
from PIL import Image

from suspnet.ground.storage import write_atomically
from suspnet.recordings.manifest_files import read_manifest
from suspnet.recordings.recording import load_recording
from suspnet.report.figures import CHANNEL_TITLES
from suspnet.report.trend import LIMIT_COLOURS

PICTURE = Path(__file__).parents[2] / "docs" / "overview.png"
SHOWN_S = 6.0
"""Length of the signals that are drawn, [s]."""
N_COLOURS = 256
"""Number of colours of the picture, the most of a palette: the file is a third as large."""
TITLES = {
    "k_p": "primary spring",
    "c_p": "primary damper",
    "k_s": "secondary spring",
    "c_s": "secondary damper",
}
RESPONSES = {"p": "axle box to frame", "s": "frame to body"}
LOOK = {
    "font.size": 16,
    "axes.titleweight": "bold",
    "axes.titlesize": 17,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def draw_signals(axis: Any, trips: pa.Table) -> None:
    """Draw the middle of the first trip, each signal over its rms."""
    recording = load_recording(read_manifest(Path(trips["manifest"][0].as_py())))
    first = recording.signals.shape[1] // 2
    part = recording.signals[:, first : first + round(SHOWN_S * recording.rate_hz)]
    seconds = np.arange(part.shape[1]) / recording.rate_hz
    for i, (name, signal) in enumerate(zip(CHANNEL_TITLES, part, strict=True)):
        rms = np.sqrt(np.mean(signal**2))
        axis.plot(seconds, signal / rms - 8 * i, lw=0.9, color=f"C{i}")
        words = f"{name}, rms {rms:.2g} m/s²"
        axis.text(0, 3.2 - 8 * i, words, color=f"C{i}", fontsize=14, va="bottom")
    axis.set(title="1  Signals of three accelerometers", xlabel="time [s]", yticks=[])
    axis.set_ylim(-20, 6)
    axis.margins(x=0)
    axis.spines["left"].set_visible(False)


def draw_responses(axes: Any, trips: pa.Table, bins: pa.Table, colours: Any) -> None:
    """Draw the magnitude of both responses of each trip."""
    names = np.array(bins["trip"].to_pylist())
    for axis, (link, title) in zip(axes, RESPONSES.items(), strict=True):
        for name, colour in zip(trips["trip"].to_pylist(), colours, strict=True):
            rows = names == name
            axis.semilogy(
                bins["frequency_hz"].to_numpy()[rows],
                bins[f"magnitude_{link}"].to_numpy()[rows],
                color=colour,
                lw=1.3,
            )
        axis.text(0.97, 0.9, title, transform=axis.transAxes, ha="right", fontsize=14)
        axis.set(xlabel="frequency [Hz]", xlim=(0, 12))
        axis.grid(True, alpha=0.3)
    axes[0].set_title("2  Frequency responses of each trip", x=0)


def draw_trend(axis: Any, trips: pa.Table, name: str, limits: dict[str, Any], colours: Any) -> None:
    """Draw a parameter along the mileage with its intervals, the truth and the lower limits."""
    columns = (f"{name}{end}" for end in ("", "_low", "_high", "_truth"))
    value, low, high, truth = (100 * trips[one].to_numpy() for one in columns)
    mileage = trips["mileage_km"].to_numpy() / 1000
    axis.plot(mileage, truth, color="0.6", lw=1.5)
    middle = len(trips) // 3
    axis.text(mileage[middle], 102, "line: the truth, dots: estimates", fontsize=14)
    axis.vlines(mileage, low, high, color=colours, lw=5, alpha=0.45)
    axis.scatter(mileage, value, color=colours, s=60, zorder=3)
    for kind, colour in LIMIT_COLOURS.items():
        limit = 100 * limits[kind][0]
        axis.axhline(limit, color=colour, ls="--", lw=1.5)
        axis.text(0, limit + 1, f"{kind} limit", color=colour, fontsize=14, va="bottom")
    axis.set(title=f"3  Trend: {TITLES[name]} [% of healthy]", xlabel="mileage [1000 km]")
    axis.set_ylim(min(low.min(), 60) - 4, 108)
    axis.set_xlim(left=0)
    axis.grid(True, alpha=0.3)


def draw(folder: Path) -> Figure:
    """Return the picture of an evaluation."""
    trips = pq.read_table(folder / "trips.parquet").sort_by("mileage_km")
    bins = pq.read_table(folder / "responses.parquet")
    trends = json.loads((folder / "metrics.json").read_text())["trends"]
    changes = {one["parameter"]: abs(one["change_percent"]) for one in trends}
    name = max(TITLES, key=changes.__getitem__)
    limits = yaml.safe_load((folder / "config.yaml").read_text())["monitor"]["limits"][name]
    colours = colormaps["viridis_r"](np.linspace(0.1, 1, len(trips)))
    with rc_context(LOOK):
        figure = Figure(figsize=(8.0, 9.2), layout="constrained", facecolor="white")
        rows = figure.subfigures(3, 1, height_ratios=[1, 1, 1.05])
        draw_signals(rows[0].subplots(), trips)
        draw_responses(rows[1].subplots(1, 2, sharey=True), trips, bins, colours)
        draw_trend(rows[2].subplots(), trips, name, limits, colours)
    return figure


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path, help="folder of an evaluation of trips")
    stream = io.BytesIO()
    draw(parser.parse_args().run).savefig(stream, format="png", dpi=100)
    image = Image.open(stream).convert("RGB").quantize(N_COLOURS)
    stream = io.BytesIO()
    image.save(stream, format="png", optimize=True)
    write_atomically(PICTURE, stream.getvalue())
    print(f"-> {PICTURE}")


if __name__ == "__main__":
    main()
