"""The application: pages, the files that they load, and error pages."""

from __future__ import annotations

import functools
import gzip
import hashlib
from collections.abc import Sequence
from importlib import resources
from importlib.metadata import version
from typing import Any

from flask import Blueprint, Flask, Response, abort, current_app, render_template, request
from flask_wtf.csrf import CSRFError
from jinja2 import FunctionLoader, StrictUndefined
from werkzeug.exceptions import HTTPException, SecurityError

from suspnet import __version__
from suspnet.history import HistoryError
from suspnet.report.templates import FILTERS, GLOBALS, packaged
from suspnet.web.pages import REFRESHER, pages
from suspnet.web.refresher import Refresher, clock
from suspnet.web.server import protect

PACKAGES = ("suspnet.web",)
"""Packages whose templates the pages use, in addition to those of reports."""
MESSAGES = {
    400: "The form or the address could not be understood.",
    404: "There is no such page.",
    405: "This page cannot be asked for in this way.",
    413: "The form is too long.",
}

FILES = {
    "style.css": ("text/css", ("suspnet.report:style.css", "suspnet.web:page.css")),
    "live.js": ("text/javascript", ("suspnet.web:live.js",)),
    "plots.js": ("text/javascript", ("suspnet.web:plots.js",)),
    "icon.svg": ("image/svg+xml", ("suspnet.web:icon.svg",)),
    "plotly.js": ("text/javascript", ("plotly:package_data/plotly.min.js",)),
}
"""MIME type and sources of each file."""
FOR_EVER = "public, max-age=31536000, immutable"
"""Caching of files whose address changes with their content."""


assets = Blueprint("assets", __name__, url_prefix="/files")


def create_app(refresher: Refresher, hosts: Sequence[str] = (), ask_every_s: float = 3.0) -> Flask:
    """Return the application.

    The caller starts the `refresher`, which holds the state of the fleet. `hosts` are accepted host
    names in addition to this computer's own; an open page polls every `ask_every_s` [s].
    """
    app = Flask("suspnet.web", static_folder=None)
    app.jinja_loader = FunctionLoader(lambda name: packaged(name, *PACKAGES))
    app.jinja_options = {"trim_blocks": True, "lstrip_blocks": True, "undefined": StrictUndefined}
    app.jinja_env.filters |= FILTERS | {"clock": clock}
    app.jinja_env.globals |= GLOBALS | {
        "file_digest": file_digest,
        "ask_every_s": ask_every_s,
        "product": f"suspnet {__version__}",
    }
    protect(app, hosts)
    app.extensions[REFRESHER] = refresher
    app.register_blueprint(pages)
    app.register_blueprint(assets)
    app.register_error_handler(CSRFError, _form_error)
    app.register_error_handler(HistoryError, _store_error)
    app.register_error_handler(HTTPException, _http_error)
    return app


def _form_error(error: CSRFError) -> Any:
    words = (
        "This form was not accepted: it is older than the start of the program, or cookies are "
        "off. Go back, reload the page and send it again."
    )
    return _message("Not accepted", words), 400


def _store_error(error: HistoryError) -> Any:
    lost = "Nothing was saved: " if request.method == "POST" else ""
    return _message("The store cannot be used", f"{lost}{error}."), 503


def _http_error(error: HTTPException) -> Any:
    if isinstance(error, SecurityError):  # no page for an unknown host name
        return "This name of the host is not answered to; see `hosts` of suspnet-serve.\n", 400
    code = error.code or 500
    own = error.description if code == 404 and request.path.startswith("/suspension/") else None
    words = own or MESSAGES.get(code) or "Something went wrong; see the program's terminal."
    return _message(error.name, words), code


def _message(title: str, words: str) -> str:
    refresher = current_app.extensions[REFRESHER]
    where = {"version": "", "of": "", "view": refresher.board.view, "refresher": refresher}
    return render_template("message_page.html", title=title, words=words, **where)


@assets.get("/<digest>/<name>")
def file(digest: str, name: str) -> Response:
    """Return a file, compressed if the browser accepts that."""
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
    """Return the part of a file's address that changes with its content."""
    if name == "plotly.js":  # plotly has five megabytes: not read at each start
        return version("plotly")
    return hashlib.sha256(_content(name)).hexdigest()[:12]


@functools.cache
def _content(name: str) -> bytes:
    parts = (part.split(":") for part in FILES[name][1])
    return b"\n".join(
        resources.files(package).joinpath(path).read_bytes() for package, path in parts
    )


@functools.cache
def _packed(name: str) -> bytes:
    return gzip.compress(_content(name), 6, mtime=0)
