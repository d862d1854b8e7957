"""Health and metrics of the server, for programs that watch it.

They need no login: they name no vehicle, and where a login is configured no store either.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from typing import Any

from flask import Blueprint, Response, current_app

from suspnet.ground.extras import import_extra
from suspnet.history import History, HistoryError
from suspnet.web.access import is_admitted
from suspnet.web.pages import REFRESHER

health = Blueprint("health", __name__)
WAIT_S = 0.5
"""Longest wait for a store that another program has locked, [s]."""


@health.get("/healthz")
def healthz() -> tuple[dict[str, Any], int]:
    """Return whether the pages follow the store: status 200, or 503.

    The reason, which names the store, is left out where a login is configured.
    """
    refresher = current_app.extensions[REFRESHER]
    fault = refresher.fault
    read_at = refresher.read_at.isoformat(timespec="seconds")
    reason = fault if is_admitted() else ""
    content = {"status": "failing" if fault else "ok", "fault": reason, "read_at": read_at}
    return content, 503 if fault else 200


@health.get("/metrics")
def metrics() -> Response:
    """Return the state of fleet and store in the text format of Prometheus."""
    try:
        prometheus = import_extra("prometheus_client", "live", "a page of metrics")
    except ValueError as error:
        return Response(f"{error}\n", 501, mimetype="text/plain")
    registry = prometheus.CollectorRegistry()
    registry.register(_State())
    return Response(prometheus.generate_latest(registry), mimetype="text/plain; version=0.0.4")


class _State:
    """Collector of the numbers of one answer."""

    def collect(self) -> Iterable[Any]:
        from prometheus_client.core import GaugeMetricFamily

        refresher = current_app.extensions[REFRESHER]
        view = refresher.board.view
        read_s = refresher.read_at.timestamp()
        yield GaugeMetricFamily(
            "suspnet_up", "Whether the pages follow the store", 0 if refresher.fault else 1
        )
        yield GaugeMetricFamily("suspnet_store_read_timestamp_seconds", "Last reading", read_s)
        yield GaugeMetricFamily("suspnet_bad_rows", "Rows left out", len(view.bad_rows))
        states = Counter(str(one.severity) for one in view.states)
        yield _by("suspnet_suspensions", "Suspensions by severity", ["severity"], states)
        alarms = Counter(
            (str(alarm.severity), str(alarm.cause))
            for one in view.states
            for alarm in one.alarms
            if alarm.is_open
        )
        yield _by("suspnet_active_alarms", "Active alarms", ["severity", "cause"], alarms)
        try:
            with History(refresher.board.store, wait_s=WAIT_S, must_exist=True) as store:
                n_waiting, n_given_up, oldest_s = store.outbox().count_unsent()
        except HistoryError:  # suspnet_up reports it
            return
        kinds = {"waiting": n_waiting, "given_up": n_given_up}
        yield _by("suspnet_unsent_messages", "Messages about alarms", ["state"], kinds)
        oldest = 0.0 if oldest_s is None else max(time.time() - oldest_s, 0.0)
        yield GaugeMetricFamily("suspnet_oldest_unsent_seconds", "Age of the oldest one", oldest)


def _by(name: str, words: str, labels: list[str], counts: Any) -> Any:
    """Return a metric with a value for each label or tuple of labels."""
    from prometheus_client.core import GaugeMetricFamily

    found = GaugeMetricFamily(name, words, labels=labels)
    for label, n in sorted(counts.items()):
        found.add_metric([label] if isinstance(label, str) else list(label), n)
    return found
