"""Messages about alarms as text, from their JSON content."""

from collections.abc import Mapping
from typing import Any

from suspnet.ground.findings import from_plain, together
from suspnet.ground.parameters import part_words
from suspnet.ground.storage import printable
from suspnet.ground.wording import kilometres
from suspnet.runs.language import N_, day, gettext, ngettext, spoken

TITLES = {
    "new": N_("New"),
    "worse": N_("Worse than reported before"),
    "known": N_("Still active"),
    "cleared": N_("Cleared since they were reported"),
    "over": N_("Raised and cleared since the last digest"),
}
"""Heading of the alarms of each state, in the order of a message."""


def subject(content: Mapping[str, Any]) -> str:
    """Return the title of a message on one line."""
    alarms = content["alarms"]
    if content["kind"] == "digest":
        active = [alarm for alarm in alarms if alarm["end_km"] is None]
        n_act = sum(alarm["severity"] == "act" for alarm in active)
        n = ngettext("%(n)s active alarm", "%(n)s active alarms", len(active))
        to_act = gettext("%(n)s to act on") % {"n": n_act}
        return f"suspnet {day(content['day'])}: {n % {'n': len(active)}}, {to_act}"
    first = alarms[0]
    more = gettext("and %(n)s more") % {"n": len(alarms) - 1} if len(alarms) > 1 else ""
    where = f"{first['vehicle']}: {spoken(first['place'])}: {_part(first)}"
    return " ".join(printable(f"suspnet: {spoken(first['severity'])}: {where} {more}").split())


def text(content: Mapping[str, Any]) -> str:
    """Return the whole message as plain text."""
    lines = []
    for state, title in TITLES.items():
        chosen = [alarm for alarm in content["alarms"] if _state(alarm) == state]
        if chosen:
            lines += [f"{gettext(title)}:", *map(_line, chosen), ""]
    if not content["alarms"]:
        lines += [gettext("No active alarm."), ""]
    if content["kind"] == "digest":
        n = content["n_suspensions"]
        words = ngettext("%(n)s suspension in the history.", "%(n)s suspensions in the history.", n)
        lines.append(words % {"n": n})
    return printable("\n".join([*lines, gettext("Message %(id)s") % {"id": content["id"]}, ""]))


def _state(alarm: Mapping[str, Any]) -> str:
    is_over = alarm["end_km"] is not None and alarm["state"] != "cleared"
    return "over" if is_over else str(alarm["state"])


def _part(alarm: Mapping[str, Any]) -> str:
    """Return a part or a sensor in words; a parameter by its symbol."""
    return spoken(part_words(alarm["parameter"]))


def _line(alarm: Mapping[str, Any]) -> str:
    begin = kilometres(alarm["begin_km"])
    since = gettext("since %(km)s") % {"km": begin}
    if alarm["end_km"] is not None:
        ends = {"low": begin, "high": kilometres(alarm["end_km"])}
        since = gettext("%(low)s to %(high)s") % ends
    seen = gettext("acknowledged by %(name)s") % {"name": alarm["acknowledged_by"]}
    by = f"; {seen}" if alarm["acknowledged_by"] else ""
    place, cause = spoken(alarm["place"]), spoken(alarm["cause"])
    where = f"{alarm['vehicle']}: {place}: {_part(alarm)} ({cause})"
    findings = together(map(from_plain, alarm.get("findings", ())))
    reason = spoken(findings or " ".join(alarm["reason"].split()))
    line = f"- {spoken(alarm['severity'])}: {where}, {since}: {reason}{by}"
    return " ".join(line.split())  # names and reasons are others' texts: none starts a line
