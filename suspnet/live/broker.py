"""An MQTT broker: its address, the credentials for it, and the topics."""

from __future__ import annotations

import logging
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from suspnet.ground.extras import import_extra
from suspnet.ground.settings import check_settings, setting
from suspnet.ground.storage import read_plain

if TYPE_CHECKING:
    from paho.mqtt.client import Client

log = logging.getLogger(__name__)
HOST_VARIABLE, LOCAL = "SUSPNET_MQTT_HOST", "localhost"
"""Environment variable that names the host of a broker, and the host without it."""
HOST = re.compile(r"[\w.:%-]+")
"""A host name, or an address of version 4 or 6."""
OUR_VARIABLE = re.compile(r"SUSPNET_[A-Z0-9_]+", re.ASCII)
"""Environment variables that may hold a password: a configuration names one, and must not be able
to send the content of any other variable to a broker."""
MOST_SECRET_BYTES = 4096
"""Largest size of a file with a password or key, [bytes]."""
MOST_PREFIX = 200
"""Largest number of characters of the topic prefix."""
KEEPALIVE_S = 30
"""A connection without traffic for one and a half times this [s] is lost."""
BACKOFF_S = (1, 30)
"""Shortest and longest time between two attempts to connect, [s]."""
MOST_PER_REQUEST = 100
"""Largest number of topics in one request of a subscription."""


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
        if not isinstance(self.password_env, str) or not OUR_VARIABLE.fullmatch(self.password_env):
            raise ValueError(
                "`password_env` must be the name of an environment variable that starts with "
                f"SUSPNET_, got {self.password_env!r}"
            )
        if (
            not isinstance(self.prefix, str)
            or not self.prefix.isprintable()
            or not 0 < len(self.prefix) <= MOST_PREFIX
            or set("+#") & set(self.prefix)
            or self.prefix[0] in "$/"
        ):
            raise ValueError(
                "`prefix` must be the short start of a topic, without + and #, not starting with $ "
                f"or /; got {self.prefix!r}"
            )
        files = (self.ca_file, self.cert_file, self.key_file)
        if any(files) and not self.tls:
            raise ValueError("`ca_file`, `cert_file` and `key_file` are for tls=true")

    def topic(self, kind: str, suspension: str) -> str:
        """Return the topic of a suspension's "frames", "estimates" or "alarms".

        Examples
        --------
        >>> Broker().topic("frames", "train 1, car 2")
        'suspnet/frames/train%201%2C%20car%202'
        """
        return f"{self.prefix}/{kind}/{quote(suspension, safe='')}"

    @property
    def where(self) -> str:
        """Host and port, as messages name them."""
        return f"{self.host}:{self.port}"

    def client(self, client_id: str, manual_ack: bool = False) -> Client:
        """Return a client, not yet connected, that reconnects with backoff.

        It raises OSError or ValueError if paho-mqtt is not installed, the password is not set, or a
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
        log.info(
            "the broker is at %s%s%s",
            self.where,
            "" if self.user is None else f", user {self.user!r}",
            ", with TLS" if self.tls else "",
        )
        return client


def secret(variable: str, owner: str) -> str:
    """Return a password or key: the environment variable's value, or the content of a file.

    The variable with ``_FILE`` after its name holds the path of that file. ValueError, which names
    the `owner` of the secret, is raised if there is neither or the name is not allowed.
    """
    if not isinstance(variable, str) or not OUR_VARIABLE.fullmatch(variable):
        raise ValueError(
            "a secret is in an environment variable whose name starts with SUSPNET_, "
            f"got {variable!r}"
        )
    found, file = os.environ.get(variable), os.environ.get(f"{variable}_FILE")
    if found is None and file:
        found = read_plain(Path(file), MOST_SECRET_BYTES).decode().rstrip("\r\n")
    if not found:
        raise ValueError(
            f"{owner} needs a secret, so the environment must hold it: export {variable}=... or "
            f"{variable}_FILE=PATH"
        )
    return found


def properties_of_connect(**values: int) -> Any:
    """Return the properties of a CONNECT packet, by their MQTT 5 names."""
    names = import_extra("paho.mqtt.packettypes", "live", "MQTT").PacketTypes
    found = import_extra("paho.mqtt.properties", "live", "MQTT").Properties(names.CONNECT)
    for name, value in values.items():
        setattr(found, name, value)
    return found
