"""The API: its description, what it answers and to whom."""

import pytest
from flask.testing import FlaskClient
from served_fleet import FAILED, SETTINGS, name_of

from suspnet.depot.web.access import Access
from suspnet.depot.web.app import create_app
from suspnet.trains.pages.board import Board, Refresher

TOKEN = "a-token-of-programs-for-tests"
BEARER = {"Authorization": f"Bearer {TOKEN}"}
BASE = "http://127.0.0.1:8050"


def client(board, access=None, peer="127.0.0.1") -> FlaskClient:
    refresher = Refresher(board, 3600.0)
    refresher.start()
    app = create_app(refresher, (), 3.0, access)
    refresher.stop()
    found = app.test_client()
    found.environ_base["REMOTE_ADDR"] = peer
    return found


@pytest.fixture(scope="module")
def ask(filled):
    visitor = client(filled[1], Access(token=TOKEN))
    return lambda path, **more: visitor.get(f"/api/v1/{path}", base_url=BASE, **more)


def test_lists_are_those_of_the_view(filled, ask):
    view = filled[1].view
    found = ask("suspensions").json
    assert [one["id"] for one in found["items"]] == list(view.names)
    assert (len(view.names), found["complete"]) == (4, True)
    acts = [one for one in ask("alarms").json["items"] if one["active"]]
    assert (acts[0]["severity"], acts[0]["end_km"]) == ("act", None)
    n_alarms = sum(len(state.watched.alarms) for state in view.states)
    assert len(ask("alarms").json["items"]) == n_alarms >= len(acts) > 0
    assert len(ask("plan").json["items"]) == len(view.plan.rows()) > 0


def test_trips_come_with_the_newest_first(filled, ask):
    name = name_of(filled[1].view, FAILED)
    found = ask(f"suspensions/{name}/trips").json["items"]
    assert [one["mileage_km"] for one in found[:2]] == [60e3, 58e3]
    assert found[0]["estimates"]["k_s"] == pytest.approx(1.5, rel=0.01)
    assert len(found) == 30


def test_parts_have_limits_and_value(filled, ask):
    name = name_of(filled[1].view, FAILED)
    found = {one["parameter"]: one for one in ask(f"suspensions/{name}/parts").json["items"]}
    assert found["k_s"]["act_percent"] == [80, 125]
    assert found["k_s"]["value_percent"] == pytest.approx(150, rel=0.01)
    assert found["k_p"]["life_median_km"] is None  # no end in sight
    assert "M_s" not in found


def test_unknown_suspensions_and_pages_are_problems_in_json(ask):
    for path in ("suspensions/0123456789ab/parts", "nothing"):
        found = ask(path)
        assert (found.status_code, found.mimetype) == (404, "application/json")
        assert found.json["detail"]


def test_history_not_read_yet_is_503(tmp_path):
    visitor = client(Board(str(tmp_path / "none.db"), SETTINGS))
    found = visitor.get("/api/v1/suspensions", base_url=BASE)
    assert found.status_code == 503
    assert found.headers["Retry-After"] == "10"


def test_a_wrong_token_is_refused(filled):
    for access in (Access(token=TOKEN), None):
        visitor = client(filled[1], access)
        wrong = {"Authorization": f"Bearer {TOKEN}x"}
        found = visitor.get("/api/v1/alarms", base_url=BASE, headers=wrong)
        assert found.status_code == 401
        assert "WWW-Authenticate" in found.headers


def test_nothing_is_written_through_the_api(filled):
    visitor, name = client(filled[1], Access(token=TOKEN)), name_of(filled[1].view, FAILED)
    for path in ("alarms", f"suspensions/{name}/acknowledgements"):
        found = visitor.post(f"/api/v1/{path}", json={}, base_url=BASE, headers=BEARER)
        assert found.status_code in (400, 404, 405)
        assert found.mimetype == "application/json"


def test_reasons_are_data_too(filled, ask):
    (found,) = ask("alarms").json["items"][0]["findings"]
    assert found["kind"] == "last-trip-beyond"
    assert found["values"]["beyond"] == {"kind": "above-act-limit", "values": {"limit": 125.0}}
    assert found["text"].endswith("of healthy, above the act limit of 125 %")
    name = name_of(filled[1].view, FAILED)
    for what in ("suspensions", f"suspensions/{name}/parts", f"suspensions/{name}/trips", "alarms"):
        for one in ask(what).json["items"]:
            texts = [one.get(key, "") for key in ("reason", "flags", "worn")]
            assert "; ".join(entry["text"] for entry in one["findings"]) == "; ".join(
                filter(None, texts)
            )
