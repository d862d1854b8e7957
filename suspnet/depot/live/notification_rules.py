"""Rules of notifications: the YAML file of recipients and channels."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from datetime import time, tzinfo
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

from suspnet.depot.live.channels import Email, NotificationChannel, Webhook
from suspnet.ground.core_yaml import read_yaml
from suspnet.ground.parameters import Severity
from suspnet.trains.history.outbox import Recipient

KINDS: Mapping[str, type] = {"email": Email, "webhook": Webhook}  # class of each kind of channel
LEVELS = {str(severity): severity for severity in (Severity.NOTICE, Severity.ACT)}
KEYS = "channels to at_once digest severities vehicles suspensions".split()  # keys of a recipient


@dataclass(frozen=True)
class Rules:
    """Recipients, the channels by name, and the zone of digest times (None: the computer's)."""

    recipients: tuple[Recipient, ...]
    channels: Mapping[str, NotificationChannel]
    zone: tzinfo | None = None


def read_rules(path: Path) -> Rules:
    """Return the rules of a file; ValueError or OSError, with place and remedy, if one is wrong.

    Secrets are looked up now, so that a missing one is an error at the start.
    """
    try:
        rules = _mapping(read_yaml(path), "the file", ("channels", "recipients", "timezone"))
        channels = {
            str(name): _channel(content, f"channels.{name}")
            for name, content in _mapping(rules.get("channels"), "channels").items()
        }
        recipients = tuple(
            _recipient(str(name), content, channels)
            for name, content in _mapping(rules.get("recipients"), "recipients").items()
        )
        zone = None if rules.get("timezone") is None else _zone(rules["timezone"])
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    if not recipients:
        raise ValueError(f"{path}: `recipients` must name a recipient")
    return Rules(recipients, channels, zone)


def _channel(content: Any, where: str) -> NotificationChannel:
    values = dict(_mapping(content, where))
    kind = values.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        raise ValueError(f"`{where}.kind` must be one of {', '.join(KINDS)}, got {kind!r}")
    _mapping(values, where, [field.name for field in fields(KINDS[kind])])
    try:
        channel: NotificationChannel = KINDS[kind](**values)
        return channel
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{where}`: {error}") from None


def _recipient(name: str, content: Any, channels: Mapping[str, NotificationChannel]) -> Recipient:
    where = f"recipients.{name}"
    values = _mapping(content, where, KEYS)
    # only the keys of the file: the defaults of the others are those of `Recipient`
    options: dict[str, Any] = {
        key: _levels(values[key], f"{where}.{key}")
        for key in ("at_once", "severities")
        if key in values
    }
    for key in ("vehicles", "suspensions"):
        if key in values:
            options[key] = _texts(values[key], f"{where}.{key}")
            if not options[key]:
                raise ValueError(f"`{where}.{key}` is empty, so that nothing would be sent")
    if "digest" in values:
        options["digest"] = _time(values["digest"], f"{where}.digest")
    recipient = Recipient(name, _targets(values, where, channels), **options)
    if recipient.digest is None and not recipient.at_once:
        raise ValueError(f"`{where}` has neither `at_once` nor `digest`: nothing would be sent")
    return recipient


def _targets(
    values: Mapping[Any, Any], where: str, channels: Mapping[str, NotificationChannel]
) -> tuple[tuple[str, str], ...]:
    """Return pairs of channel and address, which is empty for others than mails."""
    addresses = _texts(values.get("to", []), f"{where}.to")
    targets: list[tuple[str, str]] = []
    for channel in _texts(values.get("channels"), f"{where}.channels"):
        if channel not in channels:
            names = ", ".join(channels) or "none"
            raise ValueError(f"`{where}.channels`: {channel!r} is not a channel; known: {names}")
        is_mail = isinstance(channels[channel], Email)
        try:
            channels[channel].check(addresses if is_mail else ())
        except (OSError, ValueError) as error:
            raise ValueError(f"`{where}`, channel {channel!r}: {error}") from None
        targets += [(channel, address) for address in (addresses if is_mail else ("",))]
    if not targets:
        raise ValueError(f"`{where}.channels` must name a channel")
    return tuple(dict.fromkeys(targets))


def _mapping(content: Any, where: str, keys: Collection[str] | None = None) -> Mapping[Any, Any]:
    if not isinstance(content, Mapping):
        raise ValueError(f"`{where}` must be a mapping, got {content!r}")
    for key in content:
        if keys is not None and key not in keys:
            raise ValueError(f"`{where}` has no key {key!r}; known: {', '.join(keys)}")
    return content


def _texts(content: Any, where: str) -> tuple[str, ...]:
    if not isinstance(content, list) or not all(isinstance(text, str) for text in content):
        raise ValueError(f"`{where}` must be a list of texts, got {content!r}")
    return tuple(content)


def _levels(content: Any, where: str) -> frozenset[Severity]:
    names = _texts(content, where)
    if set(names) - set(LEVELS):
        raise ValueError(f"`{where}` must be of {', '.join(LEVELS)}, got {content!r}")
    return frozenset(LEVELS[name] for name in names)


def _time(content: Any, where: str) -> time | None:
    try:
        return None if content is None else time.fromisoformat(content).replace(tzinfo=None)
    except (TypeError, ValueError):
        raise ValueError(f"`{where}` must be a time such as 06:00, got {content!r}") from None


def _zone(content: Any) -> ZoneInfo:
    try:
        return ZoneInfo(content)
    except (KeyError, OSError, TypeError, ValueError):
        raise ValueError(f"`timezone` must be a name as Europe/Berlin, got {content!r}") from None
