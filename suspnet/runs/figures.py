"""Symbols and texts of figures, and figures as images in the language of the reader."""

import base64
import io
from collections.abc import Iterator
from contextlib import contextmanager

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from suspnet.ground.findings import together
from suspnet.ground.parameters import BOGIE_PARTS, ESTIMATED, kind_of, place_words
from suspnet.runs.language import spoken

MILEAGE_LABEL = "mileage [1000 km]"
SUSPENSIONS = ("primary suspension, $G_p$", "secondary suspension, $G_s$")
SYMBOLS = {
    name: together((f"${kind_of(name)}$", place_words(name) if name in BOGIE_PARTS else ""), " ")
    for name in ESTIMATED
}


def say(axis: Axes, text: str, keep_x: bool = False) -> None:
    """Write the reason on empty axes."""
    axis.text(0.5, 0.5, text, ha="center", va="center", color="0.4", transform=axis.transAxes)
    axis.set_yticks([])
    if not keep_x:
        axis.set_xticks([])


SVG_LIMIT = 400_000  # [bytes], above which a figure is embedded as PNG
PNG_DPI = 130


def _translate(figure: Figure) -> None:
    """Translate the texts of a figure, but not what its ticks name, such as trains."""
    legends = [
        *(legend for area in (figure, *figure.subfigs) for legend in area.legends),
        *(axis.get_legend() for axis in figure.axes),
    ]
    texts = [text for legend in legends if legend is not None for text in legend.get_texts()]
    for axis in figure.axes:
        texts += [axis.title, axis.xaxis.label, axis.yaxis.label, *axis.texts]
    for text in texts:
        text.set_text(spoken(text.get_text()))


def as_png(figure: Figure, dpi: float = PNG_DPI) -> bytes:
    """Return a figure as PNG, its texts in the current language."""
    stream = io.BytesIO()
    with _printed(figure, dpi):
        FigureCanvasAgg(figure).print_png(stream)
    return stream.getvalue()


def as_svg(figure: Figure) -> bytes:
    """Return a figure as SVG; the same figure gives the same bytes. As for ``as_png``."""
    stream = io.BytesIO()
    with _printed(figure), mpl.rc_context({"svg.hashsalt": "suspnet"}):
        FigureCanvasSVG(figure).print_svg(stream, metadata={"Date": None})
    return stream.getvalue()


@contextmanager
def _printed(figure: Figure, dpi: float | None = None) -> Iterator[None]:
    """Translate a figure that is printed by its canvas, which changes its resolution.

    The method `savefig` draws it twice, also if it is laid out already.
    """
    _translate(figure)
    before, figure.dpi = figure.dpi, dpi or figure.dpi
    try:
        yield
    finally:
        figure.dpi = before
    figure.set_layout_engine("none")  # it is laid out; once more would double the time


def data_uri(figure: Figure) -> str:
    """Return a figure as a data URI, SVG, or PNG if the SVG is large."""
    kind, image = "svg+xml", as_svg(figure)
    if len(image) > SVG_LIMIT:
        kind, image = "png", as_png(figure)
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
