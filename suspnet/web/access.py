"""Access: visitors that a trusted reverse proxy names, programs with a token, and their rights."""

from __future__ import annotations

import hmac
import ipaddress
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import cast

from flask import current_app, g, request
from werkzeug.exceptions import Forbidden, Unauthorized

ACCESS = "suspnet_access"
"""Key, among an application's extensions, of who may see and acknowledge."""
LEAST_TOKEN = 24
"""Least length of a token: 24 characters of base64 are 144 bits."""
MOST_NAME = 80
"""Greatest length of a visitor's name, that of an acknowledgement."""
Network = ipaddress.IPv4Network | ipaddress.IPv6Network


@dataclass(frozen=True)
class Visitor:
    """Who sent a request. `name` is empty if it is unknown.

    An engineer may acknowledge alarms, a viewer may not. `has_token` is whether a program has
    shown the token.
    """

    name: str = ""
    is_engineer: bool = True
    has_token: bool = False


@dataclass(frozen=True)
class Access:
    """Who may see and acknowledge; without arguments whoever reaches the pages.

    Parameters
    ----------
    user_header : str
        Header in which a reverse proxy names the visitor; empty: there is no login.
    trusted_proxies : sequence of str
        Addresses or networks of the proxies whose header is believed.
    engineers : sequence of str
        Names that may acknowledge, with `user_header`; others are viewers.
    token : str
        Token of programs; empty: none acknowledges.

    Raises
    ------
    ValueError
        If a name of a header, an address or the token is not valid, or the proxies of a
        `user_header` are missing, or it is missing for them.
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
        _ = self.networks  # checks the addresses
        if self.token and not re.fullmatch(rf"[!-~]{{{LEAST_TOKEN},200}}", self.token):
            raise ValueError(
                f"the token of programs must have {LEAST_TOKEN} to 200 ASCII characters and no "
                "space; make one by: openssl rand -base64 32"
            )

    @property
    def networks(self) -> list[Network]:
        """Addresses of the proxies."""
        try:
            return [ipaddress.ip_network(one) for one in self.trusted_proxies]
        except (ValueError, TypeError) as error:
            raise ValueError(f"`trusted_proxies` holds addresses or networks: {error}") from None

    def believes(self, peer: str | None) -> bool:
        """Return whether the header of a peer's request is believed."""
        try:
            address = ipaddress.ip_address(peer or "")
        except ValueError:
            return False
        return any(address in one for one in self.networks)

    def is_token(self, given: str) -> bool:
        """Return whether this is the token, in a time that does not depend on what is given."""
        wanted, shown = self.token.encode(), given.encode("utf-8", "replace")
        return bool(self.token) and hmac.compare_digest(wanted, shown)


def is_plain(text: str, allowed: str = "") -> bool:
    """Return whether a text has no control characters and marks of direction but those `allowed`.

    These are the characters of the categories C of Unicode; also unassigned ones and surrogates.
    """
    return all(one in allowed or unicodedata.category(one)[0] != "C" for one in text)


def identify_visitor() -> None:
    """Identify who asks for a page; abort with 403 if a login is configured and there is none."""
    access = current_app.extensions[ACCESS]
    g.visitor = _named(access) if access.user_header else Visitor()


def identify_program() -> None:
    """Identify who asks the API: abort with 401 for a wrong token, with 403 without a login.

    Other credentials than a token, such as those that a visitor shows to the proxy, say nothing.
    """
    access = current_app.extensions[ACCESS]
    scheme, _, token = request.headers.get("Authorization", "").partition(" ")
    if scheme.lower() != "bearer":
        identify_visitor()
        return
    if not access.is_token(token.strip()):
        raise Unauthorized("This token is not accepted: send Authorization: Bearer TOKEN.")
    g.visitor = Visitor(has_token=True)


def is_admitted() -> bool:
    """Return whether the current request may see what the store holds, and where it is."""
    return "visitor" in g or not current_app.extensions[ACCESS].user_header


def visitor() -> Visitor:
    """Return who sent the current request."""
    return cast(Visitor, g.visitor)


def _named(access: Access) -> Visitor:
    if not access.believes(request.remote_addr):
        raise Forbidden("These pages are open through their reverse proxy only.")
    given = request.headers.get(access.user_header, "").strip()
    try:
        name = given.encode("latin-1").decode("utf-8")
    except UnicodeError:
        name = given  # a proxy that sends Latin-1
    # a comma: a second header, which the visitor may have added to that of the proxy
    if not name or len(name) > MOST_NAME or "," in name or not name.isprintable():
        raise Forbidden(
            f"The reverse proxy gave no name of a visitor in {access.user_header}: log in there."
        )
    return Visitor(name, name in access.engineers)
