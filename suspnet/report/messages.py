"""Messages about alarms as text, from their JSON content."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from suspnet.ground.storage import printable
from suspnet.ground.wording import count, kilometres

TITLES = {
    "new": "New",
    "worse": "Worse than reported before",
    "known": "Still active",
    "cleared": "Cleared since they were reported",
    "over": "Raised and cleared since the last digest",
}
"""Heading of the alarms of each state, in the order of a message."""


def subject(content: Mapping[str, Any]) -> str:
    """Return the title of a message on one line."""
    alarms = content["alarms"]
    if content["kind"] == "digest":
        active = [one for one in alarms if one["end_km"] is None]
        act = sum(one["severity"] == "act" for one in active)
        return f"suspnet {content['day']}: {count(len(active), 'active alarm')}, {act} to act on"
    first = alarms[0]
    more = f" and {len(alarms) - 1} more" if len(alarms) > 1 else ""
    where = f"{first['vehicle']}: {first['place']}: {first['parameter']}"
    return " ".join(printable(f"suspnet: {first['severity']}: {where}{more}").split())


def text(content: Mapping[str, Any]) -> str:
    """Return the whole message as plain text."""
    lines = []
    for state, title in TITLES.items():
        chosen = [one for one in content["alarms"] if _state(one) == state]
        lines += [f"{title}:", *map(_line, chosen), ""] if chosen else []
    if not content["alarms"]:
        lines += ["No active alarm.", ""]
    if content["kind"] == "digest":
        lines.append(f"{count(content['n_suspensions'], 'suspension')} in the history.")
    return printable("\n".join([*lines, f"Message {content['id']}", ""]))


def _state(alarm: Mapping[str, Any]) -> str:
    is_over = alarm["end_km"] is not None and alarm["state"] != "cleared"
    return "over" if is_over else str(alarm["state"])


def _line(alarm: Mapping[str, Any]) -> str:
    since = f"since {kilometres(alarm['begin_km'])}"
    if alarm["end_km"] is not None:
        since = f"{kilometres(alarm['begin_km'])} to {kilometres(alarm['end_km'])}"
    by = f"; acknowledged by {alarm['acknowledged_by']}" if alarm["acknowledged_by"] else ""
    where = f"{alarm['vehicle']}: {alarm['place']}: {alarm['parameter']} ({alarm['cause']})"
    line = f"- {alarm['severity']}: {where}, {since}: {alarm['reason']}{by}"
    return " ".join(line.split())  # names and reasons are others' texts: none starts a line
