"""An MQTT broker: its address, the credentials for it, and the topics."""

from __future__ import annotations

import logging
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

from suspnet.ground.extras import import_extra
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.storage import read_plain

if TYPE_CHECKING:
    from paho.mqtt.client import Client

log = logging.getLogger(__name__)
HOST_VARIABLE, LOCAL = "SUSPNET_MQTT_HOST", "localhost"
"""Environment variable that names the host of a broker, and the host without it."""
HOST = re.compile(r"[\w.:%-]+")  # a host name, or an address of version 4 or 6
# A configuration names the variable of a password, and must not be able to send the content of any
# other variable to a broker.
SECRET_VARIABLE = re.compile(r"SUSPNET_[A-Z0-9_]+", re.ASCII)
MAX_SECRET_BYTES = 4096
MAX_PREFIX = 200
KEEPALIVE_S = 30  # a connection without traffic for 1.5 times this is lost
BACKOFF_S = (1, 30)  # shortest and longest time between two attempts to connect


@dataclass(frozen=True)
class Broker:
    """Address of an MQTT 5 broker and how to connect to it."""

    host: str | None = setting(
        None,
        "Name or address of the broker's machine; null is the environment variable "
        "SUSPNET_MQTT_HOST, else this machine. Only the command line and that variable can "
        "name another",
        rule="name",
    )
    port: int = setting(1883, "Port of the broker; 8883 is usual with TLS", low=1, high=65535)
    prefix: str = setting("suspnet", "First part of all topics", rule="text without + and #")
    user: str | None = setting(
        None,
        "Name of a user, whose password an environment variable holds; null is none",
        rule="text",
    )
    password_env: str = setting(
        "SUSPNET_MQTT_PASSWORD",
        "Name of that environment variable",
        rule="name that starts with SUSPNET_",
    )
    tls: bool = setting(
        False, "Whether the connection is encrypted, and the broker's certificate checked"
    )
    ca_file: str | None = setting(
        None,
        "File of the certificates of authorities that are trusted; null is the system's",
        rule="path",
    )
    cert_file: str | None = setting(
        None, "File of the client certificate, which is sent to the broker", rule="path"
    )
    key_file: str | None = setting(
        None, "File of the key of that certificate, which stays here", rule="path"
    )

    def __post_init__(self) -> None:
        check_settings(self)
        if self.host is None:
            object.__setattr__(self, "host", os.environ.get(HOST_VARIABLE) or LOCAL)
        if not isinstance(self.host, str) or not HOST.fullmatch(self.host):
            raise ValueError(f"`host` must be a name or an address, got {self.host!r}")
        if not SECRET_VARIABLE.fullmatch(str(self.password_env)):
            raise ValueError(
                "`password_env` must be the name of an environment variable that starts with "
                f"SUSPNET_, got {self.password_env!r}"
            )
        prefix = self.prefix if isinstance(self.prefix, str) else ""
        is_short = 0 < len(prefix) <= MAX_PREFIX and prefix.isprintable()
        if not is_short or set("+#") & set(prefix) or prefix[0] in "$/":
            raise ValueError(
                "`prefix` must be the short start of a topic, without + and #, not starting with $ "
                f"or /; got {self.prefix!r}"
            )
        if any((self.ca_file, self.cert_file, self.key_file)) and not self.tls:
            raise ValueError("`ca_file`, `cert_file` and `key_file` are for tls=true")

    def topic(self, suspension: str) -> str:
        """Return the topic of a suspension's frames.

        >>> Broker().topic("train 1, car 2")
        'suspnet/frames/train%201%2C%20car%202'
        """
        return f"{self.prefix}/frames/{quote(suspension, safe='')}"

    @property
    def where(self) -> str:
        """Host and port, as messages name them."""
        return f"{self.host}:{self.port}"

    def client(self, client_id: str, manual_ack: bool = False) -> Client:
        """Return a client, not yet connected, that reconnects with backoff.

        OSError or ValueError is raised if paho-mqtt is not installed, the password is not set, or a
        certificate cannot be read.
        """
        mqtt = import_extra("paho.mqtt.client", "live", "MQTT")
        client: Client = mqtt.Client(
            mqtt.CallbackAPIVersion.VERSION2, client_id, protocol=mqtt.MQTTv5, manual_ack=manual_ack
        )
        client.reconnect_delay_set(*BACKOFF_S)
        if self.user is not None:
            client.username_pw_set(self.user, secret(self.password_env, f"user {self.user!r}"))
        if self.tls:
            for file in filter(None, (self.ca_file, self.cert_file, self.key_file)):
                if not Path(file).is_file():  # opening a FIFO would block
                    raise FileNotFoundError(2, "there is no such file", file)
            client.tls_set(self.ca_file, self.cert_file, self.key_file)
        user = "" if self.user is None else f", user {self.user!r}"
        log.info("the broker is at %s%s%s", self.where, user, ", with TLS" if self.tls else "")
        return client


def secret(variable: str, owner: str) -> str:
    """Return a password or key: the environment variable's value, or the content of a file.

    The variable with ``_FILE`` after its name holds the path of that file. ValueError, which names
    the `owner` of the secret, is raised if both are missing or the name is not allowed.
    """
    if not SECRET_VARIABLE.fullmatch(str(variable)):
        raise ValueError(
            "a secret is in an environment variable whose name starts with SUSPNET_, "
            f"got {variable!r}"
        )
    value, file = os.environ.get(variable), os.environ.get(f"{variable}_FILE")
    if value is None and file:
        value = read_plain(Path(file), MAX_SECRET_BYTES).decode().rstrip("\r\n")
    if not value:
        raise ValueError(
            f"{owner} needs a secret, so the environment must hold it: export {variable}=... or "
            f"{variable}_FILE=PATH"
        )
    return value
