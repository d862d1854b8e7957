"""Health and metrics of the server, for programs that watch it.

They need no login: they name no vehicle, and where a login is configured no store either.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from typing import Any

from flask import Blueprint, Response

from suspnet.depot.web.access import is_admitted
from suspnet.depot.web.service import current_refresher, opened_store
from suspnet.ground.extras import import_extra
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
    try:
        prometheus = import_extra("prometheus_client", "live", "a page of metrics")
    except ValueError as error:
        return Response(f"{error}\n", 501, mimetype="text/plain")
    registry = prometheus.CollectorRegistry()
    registry.register(_FleetMetrics())
    return Response(prometheus.generate_latest(registry), mimetype="text/plain; version=0.0.4")


class _FleetMetrics:
    """Collector of the numbers of one answer."""

    def collect(self) -> Iterable[Any]:
        from prometheus_client.core import GaugeMetricFamily as Gauge

        refresher = current_refresher()
        view = refresher.board.view
        read_s = refresher.read_at.timestamp()
        is_up = 0 if refresher.fault else 1
        yield Gauge("suspnet_up", "Whether the pages follow the store", is_up)
        yield Gauge("suspnet_store_read_timestamp_seconds", "Last reading", read_s)
        yield Gauge("suspnet_bad_rows", "Rows left out", len(view.bad_rows))
        severities = Counter((str(state.severity),) for state in view.states)
        yield _by("suspnet_suspensions", "Suspensions by severity", ["severity"], severities)
        active = Counter(
            (str(alarm.severity), str(alarm.cause))
            for state in view.states
            for alarm in state.alarms
            if alarm.is_open
        )
        yield _by("suspnet_active_alarms", "Active alarms", ["severity", "cause"], active)
        try:
            with opened_store() as store:
                n_waiting, n_given_up, oldest_s = store.outbox().count_unsent()
        except HistoryError:  # suspnet_up reports it
            return
        states = {("waiting",): n_waiting, ("given_up",): n_given_up}
        yield _by("suspnet_unsent_messages", "Messages about alarms", ["state"], states)
        age_s = 0.0 if oldest_s is None else max(time.time() - oldest_s, 0.0)
        yield Gauge("suspnet_oldest_unsent_seconds", "Age of the oldest one", age_s)


def _by(name: str, description: str, labels: list[str], counts: Any) -> Any:
    """Return a metric with a value for each tuple of labels."""
    from prometheus_client.core import GaugeMetricFamily

    metric = GaugeMetricFamily(name, description, labels=labels)
    for values, n in sorted(counts.items()):
        metric.add_metric(list(values), n)
    return metric
