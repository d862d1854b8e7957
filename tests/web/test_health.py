"""Programs that watch the server read its health and its metrics."""

import os

import pytest
import served_fleet

from suspnet.depot.web.access import Access
from suspnet.depot.web.app import create_app
from suspnet.trains.history import History
from suspnet.trains.pages.board import Board, Refresher


@pytest.fixture
def watched(own_store):
    refresher = Refresher(Board(str(own_store), served_fleet.SETTINGS), 0.05)
    refresher.start()
    yield own_store, refresher, create_app(refresher).test_client()
    refresher.stop()


def test_health_follows_the_store(watched, wait_for):
    path, refresher, client = watched
    wait_for(lambda: refresher.words.startswith("last read"))
    answer = client.get("/healthz")
    assert (answer.status_code, answer.json["status"]) == (200, "ok")
    os.rename(path, f"{path}.away")
    wait_for(lambda: client.get("/healthz").status_code == 503)
    assert "fleet.db" in client.get("/healthz").json["fault"]
    assert b"suspnet_up 0\n" in client.get("/metrics").data


def test_with_a_login_a_fault_names_the_store_to_visitors_alone(watched, wait_for):
    path, refresher, _ = watched
    path.rename(f"{path}.away")
    wait_for(lambda: "fleet.db" in refresher.fault)
    client = create_app(refresher, access=Access("X-U", ["127.0.0.1"])).test_client()
    assert "fleet.db" in client.get("/", headers={"X-U": "Kim"}).text
    for address, code in (("/healthz", 503), ("/", 403), ("/nothing", 404), ("/metrics", 200)):
        answer = client.get(address)
        assert answer.status_code == code
        assert "fleet.db" not in answer.text
        assert "am96" not in answer.text


def test_metrics_count_suspensions_alarms_and_unsent_messages(watched, wait_for):
    parser = pytest.importorskip("prometheus_client.parser")
    path, refresher, client = watched
    wait_for(lambda: refresher.board.view.is_complete and len(refresher.board.view.states) == 4)
    answer = client.get("/metrics")
    assert answer.mimetype == "text/plain"
    samples = {
        (one.name, *sorted(one.labels.values())): one.value
        for family in parser.text_string_to_metric_families(answer.text)
        for one in family.samples
    }
    assert samples["suspnet_up",] == 1
    by_severity = {key: n for key, n in samples.items() if key[0] == "suspnet_suspensions"}
    assert sum(by_severity.values()) == 4
    assert by_severity["suspnet_suspensions", "act"] >= 1
    assert samples["suspnet_active_alarms", "act", "limit"] >= 1
    assert samples["suspnet_unsent_messages", "waiting"] == 0
    with History(path) as store:
        assert store.outbox().unsent() == []
