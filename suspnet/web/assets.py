"""Files that the pages load: style, scripts, plotly from its own Python package, the calendar."""

from __future__ import annotations

import functools
import gzip
import hashlib
import io
import threading
from importlib import resources
from importlib.metadata import version

from flask import Blueprint, Response, abort, request

from suspnet.maintenance.schedule import Plan
from suspnet.report.calendar_figure import plan_calendar

FILES = {
    "style.css": ("text/css", ("suspnet.report:style.css", "suspnet.web:page.css")),
    "live.js": ("text/javascript", ("suspnet.web:live.js",)),
    "plots.js": ("text/javascript", ("suspnet.web:plots.js",)),
    "icon.svg": ("image/svg+xml", ("suspnet.web:icon.svg",)),
    "plotly.js": ("text/javascript", ("plotly:package_data/plotly.min.js",)),
}
"""Type and parts of each file."""
FOR_EVER = "public, max-age=31536000, immutable"
"""For files whose address changes with what they hold."""

assets = Blueprint("assets", __name__, url_prefix="/files")
_drawing = threading.Lock()


@assets.get("/<digest>/<name>")
def file(digest: str, name: str) -> Response:
    """Return a file, packed if the browser takes that."""
    if name not in FILES or digest != file_digest(name):
        abort(404)
    packed = request.accept_encodings.quality("gzip") > 0
    found = Response(_packed(name) if packed else _content(name), mimetype=FILES[name][0])
    found.headers["Cache-Control"] = FOR_EVER
    found.headers["Vary"] = "Accept-Encoding"
    if packed:
        found.headers["Content-Encoding"] = "gzip"
    return found


@functools.cache
def file_digest(name: str) -> str:
    """Return what stands for the content of a file in its address."""
    if name == "plotly.js":  # five megabytes, which need not be read for each start
        return version("plotly")
    return hashlib.sha256(_content(name)).hexdigest()[:12]


@functools.cache
def _content(name: str) -> bytes:
    """Return the parts of a file one after the other."""
    parts = (part.split(":") for part in FILES[name][1])
    return b"\n".join(
        resources.files(package).joinpath(path).read_bytes() for package, path in parts
    )


@functools.cache
def _packed(name: str) -> bytes:
    """Return a file as gzip."""
    return gzip.compress(_content(name), 6, mtime=0)


def calendar(plan: Plan) -> bytes:
    """Return the calendar of a plan as SVG."""
    with _drawing:
        return _calendar(plan)


@functools.lru_cache(maxsize=2)
def _calendar(plan: Plan) -> bytes:
    stream = io.BytesIO()
    plan_calendar(plan).savefig(stream, format="svg", metadata={"Date": None})
    return stream.getvalue()
