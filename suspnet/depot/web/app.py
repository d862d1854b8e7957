"""The application and its server: pages with their files, error pages, strict headers."""

import functools
import ipaddress
import logging
import secrets
import select
import socket
from collections.abc import Sequence
from contextlib import suppress
from importlib import resources
from typing import Any

from flask import Blueprint, Flask, Response, abort, request
from flask_wtf import CSRFProtect
from flask_wtf.csrf import CSRFError
from jinja2 import FunctionLoader
from waitress.channel import HTTPChannel
from waitress.server import create_server
from werkzeug.exceptions import HTTPException, SecurityError

from suspnet import __version__
from suspnet.depot.web.access import ACCESS, Access, is_admitted
from suspnet.depot.web.api import ROOT, api, http_problem, problem
from suspnet.depot.web.health import health
from suspnet.depot.web.pages import message_page, pages
from suspnet.depot.web.service import SERVICE
from suspnet.runs.language import ENGLISH, LANGUAGES, N_, check_language, choose, gettext, spoken
from suspnet.trains.history import HistoryError
from suspnet.trains.pages.board import Refresher, clock
from suspnet.trains.pages.templates import OPTIONS, PACKAGE, equip, packaged

MESSAGES = {
    400: N_("The form or the address could not be understood."),
    404: N_("There is no such page."),
    405: N_("This page cannot be asked for in this way."),
    413: N_("The form is too long."),
}

FILES = {
    "style.css": ("text/css", ((PACKAGE, "style.css"), ("suspnet.depot.web", "page.css"))),
    "live.js": ("text/javascript", (("suspnet.depot.web", "live.js"),)),
    "icon.svg": ("image/svg+xml", (("suspnet.depot.web", "icon.svg"),)),
}
"""MIME type and sources of each file."""
assets = Blueprint("assets", __name__, url_prefix="/files")


def create_app(
    refresher: Refresher,
    hosts: Sequence[str] = (),
    ask_every_s: float = 3.0,
    access: Access | None = None,
    language: str | None = None,
) -> Flask:
    """Return the application; the caller starts the `refresher`.

    `hosts` are accepted host names in addition to this computer's own; an open page polls every
    `ask_every_s` [s]. `language` is that of all pages, None: the one that the browser asks for.
    """
    if language is not None:
        check_language(language)
    app = Flask("suspnet.depot.web", static_folder=None)
    app.jinja_loader = FunctionLoader(lambda name: packaged(name, "suspnet.depot.web"))
    app.jinja_options = OPTIONS
    equip(app.jinja_env)
    app.jinja_env.filters["clock"] = clock
    app.jinja_env.globals.update(
        is_admitted=is_admitted, ask_every_s=ask_every_s, product=f"suspnet {__version__}"
    )
    app.before_request(functools.partial(_choose_language, language))
    protected = protect(app, hosts)
    # the blueprints find fleet and rights among the extensions
    app.extensions[SERVICE] = refresher
    app.extensions[ACCESS] = access or Access()
    app.register_blueprint(pages)
    app.register_blueprint(api)
    protected.exempt(api)  # it writes nothing, and refuses in JSON
    app.register_blueprint(assets)
    app.register_blueprint(health)
    app.register_error_handler(CSRFError, _form_error)
    app.register_error_handler(HistoryError, _store_error)
    app.register_error_handler(HTTPException, _http_error)
    return app


def _choose_language(language: str | None) -> None:
    """Answer in a language, or in that of the browser; programs are answered in English."""
    if _is_api():
        choose(ENGLISH)
    else:
        choose(language or request.accept_languages.best_match(LANGUAGES, ENGLISH))


def _form_error(error: CSRFError) -> Any:
    words = gettext(
        "This form was not accepted: it is older than the start of the program, or cookies are "
        "off. Go back, reload the page and send it again."
    )
    return message_page(gettext("Not accepted"), words), 400


def _store_error(error: HistoryError) -> Any:
    lost = gettext("Nothing was saved:") + " " if request.method == "POST" else ""
    if _is_api():
        return problem(503, "The store cannot be used", f"{lost}{error}.")
    return message_page(gettext("The store cannot be used"), f"{lost}{spoken(str(error))}."), 503


def _http_error(error: HTTPException) -> Any:
    if isinstance(error, SecurityError):  # no page for an unknown host name
        return "This name of the host is not answered to; see `hosts` of suspnet-serve.\n", 400
    if _is_api():
        return http_problem(error)
    code = error.code or 500
    # the pages' own descriptions are for visitors, those of werkzeug are not
    is_own = code == 403 or (code == 404 and request.path.startswith("/suspension/"))
    description = error.description if is_own else None
    other = N_("Something went wrong; see the program's terminal.")
    words = description or gettext(MESSAGES.get(code, other))
    return message_page(gettext(error.name), words), code


def _is_api() -> bool:
    return request.path.startswith(f"{ROOT}/")


@assets.get("/<name>")
def file(name: str) -> Response:
    """Return a file, which a browser keeps as long as its content stays the same."""
    if name not in FILES:
        abort(404)
    kind, sources = FILES[name]
    files = (resources.files(package).joinpath(path) for package, path in sources)
    response = Response(b"\n".join(file.read_bytes() for file in files), mimetype=kind)
    response.headers["Cache-Control"] = "no-cache"
    response.add_etag()
    response.make_conditional(request)
    return response


MAX_FORM_BYTES = 16_384
MAX_CONNECTIONS = 150
"""Number of open connections above which the oldest one without a complete request is closed."""
SETTINGS = {
    "connection_limit": 2 * MAX_CONNECTIONS,  # not reached: older connections are closed first
    "channel_timeout": 30,  # also of an answer that its client does not read
    "cleanup_interval": 5,
    "outbuf_high_watermark": 2**40,  # no worker waits for a client: answers wait in files instead
    "max_request_header_size": 16_384,
    "max_request_body_size": 4 * MAX_FORM_BYTES,  # the pages reject smaller ones with a message
    "asyncore_use_poll": hasattr(select, "poll"),
}


class Connection(HTTPChannel):  # type: ignore[misc]
    """A connection that takes the place of the oldest waiting one if there are too many.

    One request may wait for the answer to the one before; the connection ends with its answer if
    there are more. Unread answers would otherwise fill the disk.
    """

    def __init__(self, server: Any, *arguments: Any, **named: Any) -> None:
        super().__init__(server, *arguments, **named)
        alive = [other for other in server.active_channels.values() if not other.will_close]
        if len(alive) > MAX_CONNECTIONS:
            waiting = (other for other in alive if other is not self and not other.requests)
            oldest = min(waiting, key=lambda other: other.creation_time, default=self)
            oldest.will_close = True  # the server loop closes it

    def readable(self) -> bool:
        """Return whether to wait for requests; end a connection that is to be closed."""
        if self.will_close:  # the loop closes sockets that can be written, as one is after this
            with suppress(OSError):
                self.socket.shutdown(socket.SHUT_RDWR)
        return bool(super().readable())

    def received(self, data: bytes) -> bool:
        """Take a request, and a second one that waits; drop all others."""
        has_request: bool = super().received(data)
        with self.requests_lock:
            if len(self.requests) > 2:
                self.requests[1].headers["CONNECTION"] = "close"
                for dropped in self.requests[2:]:
                    dropped.close()
                del self.requests[2:]
        return has_request


def http_server(app: Flask, listening: socket.socket, threads: int, prefix: str = "") -> Any:
    """Return the server of an application at a listening socket, with worker threads.

    `prefix` is the path below which a reverse proxy shows the pages; requests may have it or not.
    """
    logging.getLogger("waitress").setLevel(logging.ERROR)  # idle or lost clients are not errors
    app.config["APPLICATION_ROOT"] = prefix or "/"  # cookies are sent to no other application
    options = {"ident": "suspnet", "url_prefix": prefix, **SETTINGS}
    server = create_server(app, sockets=[listening], threads=threads, **options)
    server.channel_class = Connection
    return server


LOOPBACK = ("127.0.0.1", "localhost")  # host names of pages requested on this computer
SCRIPTS_AND_STYLES = (
    "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; "
    "object-src 'none'"
)
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}


def is_loopback(host: str) -> bool:
    """Return whether an address is reachable from this computer only."""
    try:
        return ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        return host == "localhost"


def protect(app: Flask, hosts: Sequence[str]) -> CSRFProtect:
    """Restrict an application to some host names, with strict headers; return its check of forms.

    Without the check of the host name, a foreign page whose own name suddenly points to this
    computer (DNS rebinding) could read and acknowledge alarms. A form needs the token of its page
    (CSRF); each start creates another key for tokens. `hosts` are names in addition to those of
    this computer itself; ".example.org" includes all names below it.
    """
    app.config.update(
        SECRET_KEY=secrets.token_bytes(32),
        TRUSTED_HOSTS=[*LOOPBACK, *hosts],
        SESSION_COOKIE_NAME="suspnet",
        SESSION_COOKIE_SAMESITE="Lax",
        SESSION_COOKIE_HTTPONLY=True,
        WTF_CSRF_TIME_LIMIT=None,
        MAX_CONTENT_LENGTH=MAX_FORM_BYTES,
    )
    app.after_request(_with_headers)
    return CSRFProtect(app)


def _with_headers(response: Response) -> Response:
    for name, value in HEADERS.items():
        response.headers.setdefault(name, value)
    response.headers["Content-Security-Policy"] = SCRIPTS_AND_STYLES
    response.headers.setdefault("Cache-Control", "no-store")
    return response
