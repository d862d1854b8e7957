"""The picture of README: from the signals of a trip to the trend of the part that has worn.

python benchmarks/overview_picture.py outputs/evaluate/RUN

RUN is an evaluation of simulated trips part by part, as README's demonstration leaves it. Letters
are large and rows below each other, so that a phone can show it; the background is opaque, for dark
pages.
"""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from cells import Parser
from matplotlib import colormaps, rc_context
from matplotlib.figure import Figure
from PIL import Image
from scipy.signal import csd

from suspnet.ground.parameters import BOGIE_PARTS, kind_of, place_words
from suspnet.ground.storage import write_atomically
from suspnet.ground.types import FloatArray
from suspnet.trains.pages.trend import LIMIT_COLOURS
from suspnet.trains.pages.trip_figures import CHANNEL_TITLES
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import load_recording

PICTURE = Path(__file__).parents[1] / "docs" / "overview.png"
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
SEGMENT_S = 4.0
"""Length of the segments of the responses that are drawn, [s]."""
BAND_HZ = (2.0, 12.0)
"""Ends of the responses that are drawn, [Hz]."""
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
    axis.set(title="1  Signals, each of a left and a right sensor", xlabel="time [s]", yticks=[])
    axis.set_ylim(-20, 6)
    axis.margins(x=0)
    axis.spines["left"].set_visible(False)


def frame_responses(path: Path) -> tuple[FloatArray, FloatArray]:
    """Return frequencies and the frame's bounce and roll where both axle boxes rise alike.

    These are the responses of mean and half difference of the frame's sensors to the mean of those
    of the axle boxes, (2, n_freq), least squares on their mean and half difference.
    """
    recording = load_recording(read_manifest(path))
    sensors = recording.sensors()
    moved = np.array(
        [
            (sensors[f"{place} left"] + sign * sensors[f"{place} right"]) / 2
            for place in ("axle_box", "bogie")
            for sign in (1, -1)
        ]
    )
    length = round(SEGMENT_S * recording.rate_hz)
    frequencies, spectra = csd(moved[:, None], moved[None], recording.rate_hz, nperseg=length)
    spectra = np.moveaxis(spectra, -1, 0)
    found = np.linalg.solve(spectra[:, :2, :2], spectra[:, :2, 2:])
    return frequencies, np.abs(found[:, 0]).T


def draw_responses(axes: Any, trips: pa.Table, colours: Any) -> None:
    """Draw bounce and roll of the frame on each trip."""
    titles = "its bounce", "its roll"
    for path, colour in zip(trips["manifest"].to_pylist(), colours, strict=True):
        frequencies, responses = frame_responses(Path(path))
        shown = (frequencies >= BAND_HZ[0]) & (frequencies <= BAND_HZ[1])
        for axis, response in zip(axes, responses, strict=True):
            axis.plot(frequencies[shown], response[shown], color=colour, lw=1.3)
    for axis, title in zip(axes, titles, strict=True):
        axis.text(0.03, 0.9, title, transform=axis.transAxes, fontsize=14)
        axis.set(xlabel="frequency [Hz]", xlim=BAND_HZ)
        axis.set_ylim(bottom=0)
        axis.grid(True, alpha=0.3)
    axes[0].set_title("2  The frame where left and right wheels rise alike", x=0)


def draw_trend(axis: Any, trips: pa.Table, name: str, limits: dict[str, Any], colours: Any) -> None:
    """Draw all parts along the mileage, one with its intervals, the truth and the lower limits."""
    columns = (f"{name}{end}" for end in ("", "_low", "_high", "_truth"))
    value, low, high, truth = (100 * trips[one].to_numpy() for one in columns)
    mileage = trips["mileage_km"].to_numpy() / 1000
    axis.plot(mileage, truth, color="0.6", lw=1.5)
    for other in set(BOGIE_PARTS) - {name}:
        axis.plot(mileage, 100 * trips[other].to_numpy(), color="0.75", lw=1, zorder=1)
    axis.text(2, 57, "dots: estimates, line: the truth", fontsize=14, color="0.4")
    axis.text(mileage[-1], 102, "the other eleven parts", fontsize=14, color="0.4", ha="right")
    named = f"{TITLES[kind_of(name)]}, {place_words(name)}"
    axis.text(mileage[-1] - 8, value[-1], named, fontsize=16, fontweight="bold", ha="right")
    axis.vlines(mileage, low, high, color=colours, lw=5, alpha=0.45)
    axis.scatter(mileage, value, color=colours, s=60, zorder=3)
    for kind, colour in LIMIT_COLOURS.items():
        limit = 100 * limits[kind][0]
        axis.axhline(limit, color=colour, ls="--", lw=1.5)
        axis.text(0, limit + 1, f"{kind} limit", color=colour, fontsize=14, va="bottom")
    axis.set(title="3  Each of twelve parts [% of healthy]", xlabel="mileage [1000 km]")
    axis.set_ylim(min(low.min(), 60) - 4, 108)
    axis.set_xlim(left=0)
    axis.grid(True, alpha=0.3)


def draw(folder: Path) -> Figure:
    """Return the picture of an evaluation."""
    trips = pq.read_table(folder / "trips.parquet").sort_by("mileage_km")
    metrics = json.loads((folder / "metrics.json").read_text())
    changes = {one["parameter"]: abs(one["change_percent"]) for one in metrics["trends"]}
    name = max(BOGIE_PARTS, key=changes.__getitem__)
    limits = metrics["limits"][name]
    colours = colormaps["viridis_r"](np.linspace(0.1, 1, len(trips)))
    with rc_context(LOOK):
        figure = Figure(figsize=(8.0, 9.2), layout="constrained", facecolor="white")
        rows = figure.subfigures(3, 1, height_ratios=[1, 1, 1.05])
        draw_signals(rows[0].subplots(), trips)
        draw_responses(rows[1].subplots(1, 2), trips, colours)
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
