"""Access: visitors that a trusted reverse proxy names, programs with a token, and their rights."""

import hmac
import ipaddress
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import cast

from flask import current_app, g, request
from werkzeug.exceptions import Forbidden, Unauthorized

ACCESS = "suspnet_access"  # key, among an application's extensions, of who may see and acknowledge
MIN_TOKEN = 24  # smallest length of a token: 24 characters of base64 are 144 bits
MAX_NAME = 80  # largest length of a visitor's name, that of an acknowledgement


@dataclass(frozen=True)
class Visitor:
    """Who sent a request. `name` is empty if it is unknown.

    An engineer may acknowledge alarms, a viewer may not.
    """

    name: str = ""
    is_engineer: bool = True


@dataclass(frozen=True)
class Access:
    """Who may see and acknowledge; without arguments whoever reaches the pages.

    `user_header` is the header in which a reverse proxy names the visitor (empty: there is no
    login), `trusted_proxies` are addresses or networks of the proxies whose header is believed, and
    `engineers` names that may acknowledge with `user_header`; others are viewers. `token` is that
    with which programs read in spite of a login (empty: none does). ValueError is raised if a value
    is not valid, or the header is given without proxies or the reverse.
    """

    user_header: str = ""
    trusted_proxies: Sequence[str] = ()
    engineers: Sequence[str] = ()
    token: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        if self.user_header and not re.fullmatch(r"[A-Za-z0-9-]{1,60}", self.user_header):
            raise ValueError(
                f"`user_header` must be the name of a header, as X-Remote-User, got "
                f"{self.user_header!r}"
            )
        if self.user_header and not self.trusted_proxies:
            raise ValueError(
                f"whose {self.user_header} is believed? Give the address of the reverse proxy, as "
                "trusted_proxies=[127.0.0.1]: others could write any name there"
            )
        if not self.user_header and (self.trusted_proxies or self.engineers):
            raise ValueError(
                "`trusted_proxies` and `engineers` need `user_header`, the header in which the "
                "reverse proxy names the visitor"
            )
        if self.token and not re.fullmatch(rf"[!-~]{{{MIN_TOKEN},200}}", self.token):
            raise ValueError(
                f"the token of programs must have {MIN_TOKEN} to 200 ASCII characters and no "
                "space; make one by: openssl rand -base64 32"
            )
        try:
            list(map(ipaddress.ip_network, self.trusted_proxies))
        except (ValueError, TypeError) as error:
            raise ValueError(f"`trusted_proxies` holds addresses or networks: {error}") from None


def current_access() -> Access:
    """Return who may see and acknowledge."""
    return cast(Access, current_app.extensions[ACCESS])


def identify_visitor() -> None:
    """Identify who asks for a page; abort with 403 if a login is configured and there is none."""
    access = current_access()
    g.visitor = _named(access) if access.user_header else Visitor()


def identify_program() -> None:
    """Identify who asks the API: abort with 401 for a wrong token, with 403 without a login.

    Other credentials than a token, such as those that a visitor shows to the proxy, are ignored.
    """
    scheme, _, token = request.headers.get("Authorization", "").partition(" ")
    if scheme.lower() != "bearer":
        identify_visitor()
        return
    expected, sent = current_access().token.encode(), token.strip().encode("utf-8", "replace")
    # in a time that does not depend on the text
    if not expected or not hmac.compare_digest(expected, sent):
        raise Unauthorized("This token is not accepted: send Authorization: Bearer TOKEN.")
    g.visitor = Visitor()


def is_admitted() -> bool:
    """Return whether the current request may see what the store holds, and where it is."""
    return "visitor" in g or not current_access().user_header


def visitor() -> Visitor:
    """Return who sent the current request."""
    return cast(Visitor, g.visitor)


def _named(access: Access) -> Visitor:
    try:
        peer = ipaddress.ip_address(request.remote_addr or "")
    except ValueError:
        peer = None
    if not any(peer and peer in ipaddress.ip_network(proxy) for proxy in access.trusted_proxies):
        raise Forbidden("These pages are open through their reverse proxy only.")
    name = request.headers.get(access.user_header, "").strip()
    with suppress(UnicodeError):  # a proxy that sends Latin-1
        name = name.encode("latin-1").decode("utf-8")
    # a comma: a second header, which the visitor may have added to that of the proxy
    if not name or len(name) > MAX_NAME or "," in name or not name.isprintable():
        raise Forbidden(
            f"The reverse proxy gave no name of a visitor in {access.user_header}: log in there."
        )
    return Visitor(name, name in access.engineers)
