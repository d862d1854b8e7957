"""Health and metrics of the server, for programs that watch it.

They need no login: they name no vehicle, and where a login is configured no store either.
"""

import time
from collections import Counter
from typing import Any

from flask import Blueprint, Response

from suspnet.depot.web.access import is_admitted
from suspnet.depot.web.service import current_refresher, opened_store
from suspnet.trains.history import HistoryError

health = Blueprint("health", __name__)


@health.get("/healthz")
def healthz() -> tuple[dict[str, Any], int]:
    """Return whether the pages follow the store: status 200, or 503.

    The reason, which names the store, is left out where a login is configured.
    """
    refresher = current_refresher()
    fault, read_at = refresher.fault, refresher.read_at.isoformat(timespec="seconds")
    reason = fault if is_admitted() else ""
    content = {"status": "failing" if fault else "ok", "fault": reason, "read_at": read_at}
    return content, 503 if fault else 200


@health.get("/metrics")
def metrics() -> Response:
    """Return the state of fleet and store in the text format of Prometheus."""
    refresher = current_refresher()
    view = refresher.board.view
    values: dict[str, float] = {
        "suspnet_up": 0 if refresher.fault else 1,
        "suspnet_store_read_timestamp_seconds": refresher.read_at.timestamp(),
        "suspnet_bad_rows": len(view.bad_rows),
    }
    values |= Counter(f'suspnet_suspensions{{severity="{s.severity}"}}' for s in view.states)
    values |= Counter(
        f'suspnet_active_alarms{{severity="{alarm.severity}",cause="{alarm.cause}"}}'
        for state in view.states
        for alarm in state.alarms
    )
    try:
        with opened_store() as store:
            n_waiting, n_given_up, oldest_s = store.outbox().count_unsent()
        age_s = 0.0 if oldest_s is None else max(time.time() - oldest_s, 0.0)
        values |= {
            'suspnet_unsent_messages{state="waiting"}': n_waiting,
            'suspnet_unsent_messages{state="given_up"}': n_given_up,
            "suspnet_oldest_unsent_seconds": age_s,
        }
    except HistoryError:  # suspnet_up reports it
        pass
    text = "".join(f"{name} {value!r}\n" for name, value in values.items())
    return Response(text, mimetype="text/plain; version=0.0.4")
