"""Rules of notifications: the YAML file of recipients and channels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from datetime import time, tzinfo
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from suspnet.ground.parameters import Severity
from suspnet.history.outbox import Recipient
from suspnet.live.broker import Broker
from suspnet.live.channels import Channel, Email, MqttChannel, Webhook
from suspnet.recordings.core_yaml import read_yaml

KINDS: Mapping[str, type] = {"email": Email, "mqtt": Broker, "webhook": Webhook}
"""Class that checks the settings of each kind of channel."""
LEVELS = {str(one): one for one in (Severity.NOTICE, Severity.ACT)}
"""Severities by their names."""
KEYS = "channels to at_once digest severities vehicles suspensions".split()
"""Keys of a recipient."""


@dataclass(frozen=True)
class Rules:
    """Recipients, the channels by name, and the zone of digest times (None: the computer's)."""

    recipients: tuple[Recipient, ...]
    channels: Mapping[str, Channel]
    zone: tzinfo | None = None


def read_rules(path: Path) -> Rules:
    """Return the rules of a file; ValueError or OSError, with place and remedy, if one is wrong.

    Secrets are looked for now, so that a missing one is an error at the start.
    """
    try:
        content = read_yaml(path)
        top = _mapping(content, "the file", ("channels", "recipients", "timezone"))
        channels = {
            str(name): _channel(one, f"channels.{name}")
            for name, one in _mapping(top.get("channels"), "channels").items()
        }
        recipients = tuple(
            _recipient(str(name), one, channels)
            for name, one in _mapping(top.get("recipients"), "recipients").items()
        )
        zone = None if top.get("timezone") is None else _zone(top["timezone"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    if not recipients:
        raise ValueError(f"{path}: `recipients` must name a recipient")
    return Rules(recipients, channels, zone)


def _channel(given: Any, where: str) -> Channel:
    values = dict(_mapping(given, where))
    kind = values.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"`{where}.kind` must be one of {', '.join(KINDS)}, got {kind!r}")
    known = [one.name for one in fields(KINDS[kind])]
    _mapping(values, where, known)
    try:
        built = KINDS[kind](**values)
        return MqttChannel(built) if isinstance(built, Broker) else built
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{where}`: {error}") from None


def _recipient(name: str, given: Any, channels: Mapping[str, Channel]) -> Recipient:
    where = f"recipients.{name}"
    values = _mapping(given, where, KEYS)
    to = _texts(values.get("to", []), f"{where}.to")
    targets: list[tuple[str, str]] = []
    for channel in _texts(values.get("channels"), f"{where}.channels"):
        if channel not in channels:
            known = ", ".join(channels) or "none"
            raise ValueError(f"`{where}.channels`: {channel!r} is not a channel; known: {known}")
        is_mail = isinstance(channels[channel], Email)
        own = to if is_mail else ()
        try:
            channels[channel].check(own)
        except (OSError, ValueError) as error:
            raise ValueError(f"`{where}`, channel {channel!r}: {error}") from None
        targets += [(channel, one) for one in own] if is_mail else [(channel, "")]
    if not targets:
        raise ValueError(f"`{where}.channels` must name a channel")
    chosen: dict[str, Any] = {}
    for key in ("at_once", "severities"):
        if key in values:
            chosen[key] = _levels(values[key], f"{where}.{key}")
    for key in ("vehicles", "suspensions"):
        if key in values:
            chosen[key] = _texts(values[key], f"{where}.{key}")
            if not chosen[key]:
                raise ValueError(f"`{where}.{key}` is empty, so that nothing would be sent")
    if "digest" in values:
        chosen["digest"] = _time(values["digest"], f"{where}.digest")
    found = Recipient(name, tuple(dict.fromkeys(targets)), **chosen)
    if found.digest is None and not found.at_once:
        raise ValueError(f"`{where}` has neither `at_once` nor `digest`: nothing would be sent")
    return found


def _mapping(given: Any, where: str, known: Any = None) -> Mapping[Any, Any]:
    if not isinstance(given, Mapping):
        raise ValueError(f"`{where}` must be a mapping, got {given!r}")
    for key in given:
        if known is not None and key not in known:
            raise ValueError(f"`{where}` has no key {key!r}; known: {', '.join(known)}")
    return given


def _texts(given: Any, where: str) -> tuple[str, ...]:
    if not isinstance(given, list) or not all(isinstance(one, str) for one in given):
        raise ValueError(f"`{where}` must be a list of texts, got {given!r}")
    return tuple(given)


def _levels(given: Any, where: str) -> frozenset[Severity]:
    names = _texts(given, where)
    if set(names) - set(LEVELS):
        raise ValueError(f"`{where}` must be of {', '.join(LEVELS)}, got {given!r}")
    return frozenset(LEVELS[one] for one in names)


def _time(given: Any, where: str) -> time | None:
    try:
        return None if given is None else time.fromisoformat(given).replace(tzinfo=None)
    except (TypeError, ValueError):
        raise ValueError(f"`{where}` must be a time such as 06:00, got {given!r}") from None


def _zone(given: Any) -> ZoneInfo:
    try:
        return ZoneInfo(given)
    except (KeyError, OSError, TypeError, ValueError):
        raise ValueError(f"`timezone` must be a name as Europe/Berlin, got {given!r}") from None
