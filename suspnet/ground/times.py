"""Times of trips."""

from __future__ import annotations

from datetime import UTC, datetime


def utc(text: str) -> datetime | None:
    """Return a start without a zone, converted to UTC if it has one; None if it is empty."""
    if not text:
        return None
    try:
        time = datetime.fromisoformat(text)
        return time.astimezone(UTC).replace(tzinfo=None) if time.tzinfo else time
    except (ValueError, OverflowError):
        raise ValueError(f"`start` must be a time in ISO 8601, not {text[:40]!r}") from None
