"""The HTTP server: it stays responsive with hundreds of idle connections, and checks host names."""

from __future__ import annotations

import ipaddress
import logging
import secrets
import select
import socket
from collections.abc import Sequence
from typing import Any

from flask import Flask, Response, request
from flask_wtf import CSRFProtect
from waitress.channel import HTTPChannel
from waitress.server import create_server

MAX_FORM_BYTES = 16_384
MOST_CONNECTIONS = 150
"""Number of open connections above which the oldest one without a complete request is closed."""
SETTINGS = {
    "connection_limit": 2 * MOST_CONNECTIONS,  # not reached: older connections are closed first
    "channel_timeout": 30,
    "cleanup_interval": 5,
    "max_request_header_size": 16_384,
    "max_request_body_size": 4 * MAX_FORM_BYTES,  # the pages reject smaller ones with a message
    "asyncore_use_poll": hasattr(select, "poll"),
}


class Channel(HTTPChannel):  # type: ignore[misc]
    """A connection that takes the place of the oldest waiting one if there are too many."""

    def __init__(self, server: Any, *arguments: Any, **named: Any) -> None:
        super().__init__(server, *arguments, **named)
        open_ones = [one for one in server.active_channels.values() if not one.will_close]
        if len(open_ones) > MOST_CONNECTIONS:
            waiting = (one for one in open_ones if one is not self and not one.requests)
            oldest = min(waiting, key=lambda one: one.creation_time, default=self)
            oldest.will_close = True  # the server loop closes it


def http_server(app: Flask, listening: socket.socket, threads: int) -> Any:
    """Return the server of an application at a listening socket, with worker threads."""
    logging.getLogger("waitress").setLevel(logging.ERROR)  # idle or lost clients are not errors
    server = create_server(app, sockets=[listening], threads=threads, ident="suspnet", **SETTINGS)
    server.channel_class = Channel
    return server


LOOPBACK = ("127.0.0.1", "localhost")
"""Host names of pages requested on this computer."""
SCRIPTS_AND_STYLES = (
    "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; "
    "object-src 'none'"
)
STYLES_OF_PLOTS = "; style-src 'self' 'unsafe-inline'"
"""Plotly sets inline styles of its elements; no page needs inline scripts."""
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
WITH_PLOTS = "suspnet.plots"
"""Key in a request's environment that marks a page with plots."""


def is_loopback(host: str) -> bool:
    """Return whether an address is reachable from this computer only."""
    try:
        return ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        return host == "localhost"


def protect(app: Flask, hosts: Sequence[str]) -> None:
    """Restrict an application to some host names, with strict headers.

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
    CSRFProtect(app)
    app.after_request(_with_headers)


def _with_headers(response: Response) -> Response:
    for name, value in HEADERS.items():
        response.headers.setdefault(name, value)
    styles = STYLES_OF_PLOTS if request.environ.get(WITH_PLOTS) else ""
    response.headers["Content-Security-Policy"] = SCRIPTS_AND_STYLES + styles
    response.headers.setdefault("Cache-Control", "no-store")
    return response
