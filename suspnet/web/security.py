"""What keeps other people's pages away from this one: names of the host, headers, cookies."""

from __future__ import annotations

import ipaddress
import secrets
from collections.abc import Sequence

from flask import Flask, Response, request
from flask_wtf import CSRFProtect

LOOPBACK = ("127.0.0.1", "localhost")
"""Names by which a browser on this computer asks for the pages."""
MAX_FORM_BYTES = 16_384
SCRIPTS_AND_STYLES = (
    "default-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'; "
    "object-src 'none'"
)
STYLES_OF_PLOTS = "; style-src 'self' 'unsafe-inline'"
"""Plotly sets styles of the elements that it makes; no page needs scripts other than files."""
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), geolocation=(), microphone=()",
}
WITH_PLOTS = "suspnet.plots"
"""Key of a request's environment that says that its page has plots."""


def is_loopback(host: str) -> bool:
    """Return whether only this computer reaches an address."""
    try:
        return ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        return host == "localhost"


def protect(app: Flask, hosts: Sequence[str]) -> None:
    """Let an application answer to some names of the host only, with strict headers.

    Without the check of the name, a foreign page whose own name suddenly points to this computer
    (DNS rebinding) could read and acknowledge alarms. A form needs the token that its page holds
    (CSRF); the key that signs tokens is made anew at each start.

    Parameters
    ----------
    app : Flask
    hosts : sequence of str
        Names besides those of this computer itself; ".example.org" is all names below it.
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
    """Add the headers to an answer."""
    for name, value in HEADERS.items():
        response.headers.setdefault(name, value)
    styles = STYLES_OF_PLOTS if request.environ.get(WITH_PLOTS) else ""
    response.headers["Content-Security-Policy"] = SCRIPTS_AND_STYLES + styles
    response.headers.setdefault("Cache-Control", "no-store")
    return response
