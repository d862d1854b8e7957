"""Matplotlib figures as images."""

from __future__ import annotations

import base64
import io

import matplotlib as mpl
from matplotlib.figure import Figure

SVG_LIMIT = 400_000
"""Size of an SVG [bytes] above which a figure is embedded as PNG."""
PNG_DPI = 130


def as_png(figure: Figure, dpi: float = PNG_DPI) -> bytes:
    """Return a figure as PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    return stream.getvalue()


def as_svg(figure: Figure) -> bytes:
    """Return a figure as SVG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    with mpl.rc_context({"svg.hashsalt": "suspnet"}):
        figure.savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()


def data_uri(figure: Figure) -> str:
    """Return a figure as a data URI, SVG, or PNG if the SVG is large."""
    kind, image = "svg+xml", as_svg(figure)
    if len(image) > SVG_LIMIT:
        kind, image = "png", as_png(figure)
    return f"data:image/{kind};base64,{base64.b64encode(image).decode()}"
