"""Channels of messages about alarms: a webhook and e-mail.

`send` returns once the server has accepted a message and raises DeliveryError otherwise; its text
contains no secret and no path of a URL, which may be one.
"""

import base64
import hashlib
import hmac
import http.client
import re
import smtplib
import ssl
import time
from contextlib import closing, suppress
from dataclasses import dataclass
from email.message import EmailMessage
from email.utils import formatdate
from string import punctuation
from typing import Literal
from urllib.parse import quote, urlsplit

from suspnet.depot.live.broker import secret
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.storage import json_bytes
from suspnet.runs.language import speaking
from suspnet.trains.history.outbox import Message
from suspnet.trains.pages.messages import subject, text

TIMEOUT_S = 20.0  # longest time that a server may take for a step of its answer, [s]
ADDRESS = re.compile(r"[^@\s<>,;:\"()\[\]\\]+@[A-Za-z0-9.-]+")  # an e-mail address without a name


class DeliveryError(Exception):
    """A server did not accept a message."""


class AddressError(DeliveryError):
    """A server did not accept one address; it may accept others."""


@dataclass(frozen=True)
class Webhook:
    """POST of JSON, signed as Standard Webhooks says: HMAC-SHA256 of id, time and body."""

    url: str = setting("", "Address that messages are posted to", rule="https:// or http://")
    secret_env: str = setting(
        "SUSPNET_WEBHOOK_SECRET",
        "Environment variable with the key of the signature",
        rule="name that starts with SUSPNET_",
    )

    def __post_init__(self) -> None:
        check_settings(self)
        url = urlsplit(self.url)
        if url.scheme not in ("http", "https") or not url.hostname or url.username:
            raise ValueError("`url` must be https://HOST/... without a user or a password")
        _ = url.port  # checks its range

    def check(self, addresses: tuple[str, ...]) -> None:
        """Raise ValueError without a key of at least 16 bytes."""
        self._key()

    def send(self, message: Message) -> None:
        """Post a message; a redirection is not followed."""
        body, stamp = json_bytes(message.content), str(int(time.time()))
        signed = b".".join([message.id.encode(), stamp.encode(), body])
        mac = base64.b64encode(hmac.digest(self._key(), signed, hashlib.sha256)).decode()
        headers = {
            "Content-Type": "application/json",
            "User-Agent": "suspnet",
            "webhook-id": message.id,
            "webhook-timestamp": stamp,
            "webhook-signature": f"v1,{mac}",
        }
        url = urlsplit(self.url)
        target = (url.path or "/") + (f"?{url.query}" if url.query else "")
        host = url.hostname or ""
        is_https = url.scheme == "https"
        kind = http.client.HTTPSConnection if is_https else http.client.HTTPConnection
        try:
            with closing(kind(host, url.port, timeout=TIMEOUT_S)) as client:
                client.request("POST", quote(target, safe=punctuation), body, headers)
                # the content of the answer is not read: it may be of any size, or never end
                status = client.getresponse().status
        except (http.client.HTTPException, OSError, ValueError) as error:
            raise DeliveryError(f"{host}: {type(error).__name__}") from None
        if not 200 <= status < 300:
            raise DeliveryError(f"{host}: HTTP status {status}")

    def _key(self) -> bytes:
        text = secret(self.secret_env, "a webhook").removeprefix("whsec_")
        with suppress(ValueError):
            key = base64.b64decode(text, validate=True)
            if len(key) >= 16:
                return key
        raise ValueError(
            f"{self.secret_env} must be the base64 of 24 to 64 random bytes, as of: "
            "openssl rand -base64 32"
        )


@dataclass(frozen=True)
class Email:
    """A mail to each address, through an SMTP server."""

    host: str = setting("", "Name of the SMTP server", rule="name")
    port: int = setting(587, "Its port", low=1, high=65535)
    security: Literal["starttls", "tls", "none"] = setting(
        "starttls", "Encryption, with the server's certificate checked"
    )
    sender: str = setting("", "Address of the sender", rule="address")
    user: str | None = setting(None, "User of the server; null is no login", rule="text")
    password_env: str = setting(
        "SUSPNET_SMTP_PASSWORD",
        "Environment variable with the user's password",
        rule="name that starts with SUSPNET_",
    )
    language: Literal["en", "de"] = setting("en", "Language of the mails")

    def __post_init__(self) -> None:
        check_settings(self)
        if not isinstance(self.host, str) or not re.fullmatch(r"[\w.:-]+", self.host):
            raise ValueError(f"`host` must be the name of a server, got {self.host!r}")
        if not isinstance(self.sender, str) or not ADDRESS.fullmatch(self.sender):
            raise ValueError(f"`sender` must be an e-mail address, got {self.sender!r}")
        if self.user is not None and self.security == "none":
            raise ValueError("`security: none` would send the password of `user` unencrypted")

    def check(self, addresses: tuple[str, ...]) -> None:
        """Raise ValueError without an address or the password."""
        if self.user is not None:
            secret(self.password_env, f"user {self.user!r} of {self.host}")
        wrong = [address for address in addresses if not ADDRESS.fullmatch(address)]
        if wrong or not addresses:
            raise ValueError(f"`to` must list e-mail addresses, got {wrong or 'none'}")

    def send(self, message: Message) -> None:
        """Send one mail to one address."""
        mail, is_accepted = self._mail(message), False
        context = ssl.create_default_context()
        server = smtplib.SMTP(timeout=TIMEOUT_S)
        if self.security == "tls":
            server = smtplib.SMTP_SSL(timeout=TIMEOUT_S, context=context)
        server._host = self.host  # type: ignore[attr-defined]  # that certificates must be of
        try:
            with closing(server):
                server.connect(self.host, self.port)
                if self.security == "starttls":
                    server.starttls(context=context)
                if self.user is not None:
                    server.login(self.user, secret(self.password_env, "the mail server"))
                server.send_message(mail)
                is_accepted = True
                server.quit()
        except smtplib.SMTPRecipientsRefused:
            raise AddressError(f"{self.host}: the address is refused") from None
        except (OSError, ValueError) as error:
            if is_accepted:  # only the end of the connection failed: not to be sent again
                return
            status = getattr(error, "smtp_code", None)
            reason = type(error).__name__ if status is None else f"SMTP status {status}"
            raise DeliveryError(f"{self.host}: {reason}") from None

    def _mail(self, message: Message) -> EmailMessage:
        mail = EmailMessage()
        mail["From"], mail["To"] = self.sender, message.address
        with speaking(self.language):
            mail["Subject"], content = subject(message.content), text(message.content)
        mail["Date"] = formatdate()
        mail["Message-ID"] = f"<{message.id}@{self.sender.rpartition('@')[2]}>"
        mail["Auto-Submitted"] = "auto-generated"
        mail.set_content(content)
        return mail
