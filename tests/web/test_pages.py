"""The pages as Flask's test client reads them: content, escaping, protection, errors."""

import re
from contextlib import contextmanager
from dataclasses import replace

import pytest
from served_fleet import EVIL, FAILED, HEALTHY, NAMED_EVIL, SETTINGS, WORN, name_of, trips

from suspnet.depot.web.app import create_app
from suspnet.ground.parameters import Severity
from suspnet.ground.records import SensorHealth, sensors_text
from suspnet.trains.history import History
from suspnet.trains.pages.board import Board, Refresher

BASE = {"base_url": "http://127.0.0.1:8050"}


@contextmanager
def refreshed(board, wait_for):
    """Give the state of a fleet, worked out once; the thread runs and sleeps."""
    refresher = Refresher(board, 3600.0)
    refresher.start()
    wait_for(lambda: refresher.words.startswith("last read"))
    yield refresher
    refresher.stop()


@pytest.fixture(scope="module")
def only_read(filled, wait_for):
    with refreshed(filled[1], wait_for) as refresher:
        yield refresher


@pytest.fixture
def refresher(request, wait_for):
    """The state of one fleet for all tests, but of a store of its own where a test asks for it."""
    if "own_store" not in request.fixturenames:
        yield request.getfixturevalue("only_read")
        return
    board = Board(str(request.getfixturevalue("own_store")), SETTINGS)
    with refreshed(board, wait_for) as refresher:
        yield refresher


@pytest.fixture
def client(refresher):
    return create_app(refresher, ["depot.lan"]).test_client()


def token(page):
    return re.search(r'name="csrf_token" value="([^"]+)"', page)[1]


def form(page, **changes):
    given = {"parameter": "k_s", "cause": "limit", "severity": "act", "by": "Kim Li", "words": "ok"}
    return {"csrf_token": token(page), **given, **changes}


def test_fleet_shows_every_suspension_in_words_and_signs(client, refresher):
    page = client.get("/", **BASE).text
    assert "4 suspensions: 2 to act on, 1 to be looked at, 1 without alarm." in page
    for place, sign in ((FAILED, "✕"), (WORN, "!"), (HEALTHY, "✓")):
        name = name_of(refresher.board.view, place)
        tile = re.search(rf'<a class="tile[^>]*href="/suspension/{name}".*?</a>', page)[0]
        assert sign in tile
    assert 'trail. left</span><span class="hidden">, Notice</span>' in page
    assert "<span>hinten links</span>" in client.get("/", headers=GERMAN, **BASE).text
    assert page.index("Train 9") < page.index("Train 12")  # as numbers
    assert page.count('">Acknowledge<') == len(re.findall(r"#alarm-", page)) >= 3


def test_fleet_is_filtered_by_train_and_state(client):
    page = client.get("/?train=12", **BASE).text
    assert "2 suspensions: 1 to act on, 1 to be looked at." in page
    assert "Train 9<" not in page
    assert "<option selected>12</option>" in page
    assert "1 suspension: 1 without alarm." in client.get("/?severity=none", **BASE).text
    assert "No suspension matches." in client.get("/?train=77", **BASE).text
    assert "4 suspensions" in client.get("/?severity=odd", **BASE).text


def test_names_are_shown_as_text(client, refresher):
    escaped = "&lt;script&gt;window.evil = 1&lt;/script&gt;"
    name = name_of(refresher.board.view, NAMED_EVIL)
    for address in ("/", f"/?train={EVIL}", "/plan", f"/suspension/{name}"):
        page = client.get(address, **BASE).text
        assert EVIL not in page
        assert "<u>1" not in page
        assert escaped in page, address


def test_suspension_has_all_that_is_known(client, refresher):
    page = client.get(f"/suspension/{name_of(refresher.board.view, WORN)}", **BASE).text
    assert "<h1>train 12, car 3, trailing bogie, left</h1>" in page
    assert "30, of which 30 with an estimate, 1 of these flagged" in page
    assert page.index("trip_029") < page.index("trip_010")
    assert "trip_009" not in page.split('id="trips"')[1]
    assert "2 000 to 60 000 km".replace(" 0", "\N{NO-BREAK SPACE}0") in page
    assert page.count('<script src="/files/') == 1
    assert not re.search(r"<script(?! src=)|\son\w+=|style=", page)
    healthy = client.get(f"/suspension/{name_of(refresher.board.view, HEALTHY)}", **BASE).text
    assert "No alarm is active." in healthy
    assert "<form" not in healthy


def test_plan_and_its_calendar(client):
    page = client.get("/plan", **BASE).text
    assert '<td class="start">2026-03-15</td>' in page
    jobs = page.count('<th scope="row">')
    of_train = client.get("/plan?train=12", **BASE).text
    assert 0 < of_train.count('<th scope="row">train 12, car 3<') < jobs
    assert "train 9" not in of_train
    picture = client.get("/plan/calendar.svg", **BASE)
    assert picture.mimetype == "image/svg+xml"
    assert b"<svg" in picture.data


def test_acknowledgement_lands_in_the_store(client, refresher, own_store, wait_for):
    address = f"/suspension/{name_of(refresher.board.view, FAILED)}"
    answer = client.post(
        f"{address}/acknowledge", data=form(client.get(address, **BASE).text), **BASE
    )
    assert (answer.status_code, answer.location) == (302, address)
    page = client.get(address, **BASE).text
    assert "Acknowledged by Kim Li: k_s (limit)." in page
    assert re.search(r"Seen by Kim Li, \d{4}-\d\d-\d\d: ok", page)
    assert 'value="Kim Li"' in page  # the next form knows the name
    with History(own_store) as store:
        (kept,) = store.acknowledgements("am96", FAILED)
    assert (kept.parameter, kept.cause, kept.severity) == ("k_s", "limit", Severity.ACT)
    assert (kept.by, kept.words, kept.at_km) == ("Kim Li", "ok", 60_000.0)
    wait_for(lambda: "Kim Li" in client.get("/", **BASE).text)


def test_acknowledgement_needs_token_and_name(client, refresher, own_store):
    address = f"/suspension/{name_of(refresher.board.view, FAILED)}"
    page = client.get(address, **BASE).text
    for changes in ({"csrf_token": ""}, {"csrf_token": "x"}):
        refused = client.post(f"{address}/acknowledge", data=form(page, **changes), **BASE)
        assert refused.status_code == 400
        assert "This form was not accepted" in refused.text
    stranger = create_app(refresher).test_client()  # another session, as another site's would be
    assert stranger.post(f"{address}/acknowledge", data=form(page), **BASE).status_code == 400
    nameless = client.post(f"{address}/acknowledge", data=form(page, by=""), headers=GERMAN, **BASE)
    assert "Bitte den Namen eingeben." in nameless.text
    unnamed = client.post(f"{address}/acknowledge", data=form(page, by=" "), **BASE)
    assert unnamed.status_code == 400
    assert "Enter your name." in unnamed.text
    assert "data-state" not in unnamed.text  # nothing takes the form away
    assert 'value="ok"' in unnamed.text
    forged = client.post(f"{address}/acknowledge", data=form(page, by="Kim\u202eLi"), **BASE)
    assert forged.status_code == 400
    assert "Leave out control characters." in forged.text
    with History(own_store) as store:
        assert store.acknowledgements("am96", FAILED) == []


def test_alarm_that_is_over_or_worse_than_shown_is_not_acknowledged(client, refresher, own_store):
    address = f"/suspension/{name_of(refresher.board.view, FAILED)}"
    page = client.get(address, **BASE).text
    for changes in ({"severity": "notice"}, {"severity": "x"}, {"parameter": "c_p"}):
        answer = client.post(f"{address}/acknowledge", data=form(page, **changes), **BASE)
        assert answer.status_code == 302
        assert "Nothing was acknowledged" in client.get(address, **BASE).text
    with History(own_store) as store:
        assert store.acknowledgements("am96", FAILED) == []


def test_foreign_names_of_the_host_are_refused(client):
    for host in ("127.0.0.1:8050", "localhost", "depot.lan:80"):
        assert client.get("/", headers={"Host": host}).status_code == 200
    for address in ("/", "/state", "/nothing", "/healthz", "/metrics"):
        answer = client.get(address, headers={"Host": "evil.example"})
        assert answer.status_code == 400
        assert "suspension" not in answer.text


def test_headers_of_every_answer(client, refresher):
    name = name_of(refresher.board.view, FAILED)
    for address in ("/", "/plan", f"/suspension/{name}", "/state", "/nothing"):
        headers = client.get(address, **BASE).headers
        policy = headers["Content-Security-Policy"]
        assert policy.startswith("default-src 'self'; ")
        assert "frame-ancestors 'none'" in policy
        assert "script-src" not in policy  # as default-src: files of this program alone
        assert "unsafe-inline" not in policy
        assert headers["X-Content-Type-Options"] == "nosniff"
        assert headers["Referrer-Policy"] == "same-origin"
        assert headers["Cache-Control"] == "no-store"
    client.delete_cookie("suspnet", domain="127.0.0.1")
    cookie = client.get(f"/suspension/{name}", **BASE).headers["Set-Cookie"]
    assert "SameSite=Lax" in cookie
    assert "HttpOnly" in cookie


def test_files_are_sent_once(client, refresher):
    page = client.get(f"/suspension/{name_of(refresher.board.view, FAILED)}", **BASE).text
    addresses = re.findall(r'(?:src|href)="(/files/[^"]+)"', page)
    assert len(addresses) == 3
    for address in addresses:
        first = client.get(address, **BASE)
        again = client.get(address, headers={"If-None-Match": first.headers["ETag"]}, **BASE)
        assert (first.status_code, again.status_code, again.data) == (200, 304, b"")
    assert client.get("/files/../app.py", **BASE).status_code == 404


def test_state_is_light_and_changes_with_what_a_page_shows(client, refresher, own_store, wait_for):
    name, other = (name_of(refresher.board.view, one) for one in (HEALTHY, FAILED))

    def versions():
        found = (client.get(f"/state?of={of}", **BASE) for of in ("", name, other))
        return [answer.json["version"] for answer in found]

    before = versions()
    assert versions() == before
    assert len(client.get("/state", **BASE).data) < 200
    with History(own_store) as store:
        store.write(trips(HEALTHY, 3, n_trips=1, begin=40))
    refresher.soon()
    wait_for(lambda: versions()[1] != before[1])
    wait_for(lambda: refresher.board.view.is_complete)
    after = versions()
    assert after[0] != before[0]
    assert after[2] == before[2]
    for page, version in (("/", after[0]), (f"/suspension/{name}", after[1])):
        assert f'data-version="{version}"' in client.get(page, **BASE).text


def test_store_that_has_gone_is_told_with_the_last_state(client, refresher, own_store, wait_for):
    address = f"/suspension/{name_of(refresher.board.view, FAILED)}"
    csrf = form(client.get(address, **BASE).text)
    own_store.rename(own_store.with_suffix(".away"))
    refresher.soon()
    wait_for(lambda: "The store cannot be read" in client.get("/", **BASE).text)
    page = client.get("/", **BASE).text
    assert "This page shows the state of" in page
    assert "4 suspensions" in page
    assert "trips and responses are not shown" in client.get(address, **BASE).text
    answer = client.post(f"{address}/acknowledge", data=csrf, **BASE)
    assert answer.status_code == 503
    assert "Nothing was saved" in answer.text
    assert not own_store.exists()  # nor was a new one made
    own_store.with_suffix(".away").rename(own_store)
    refresher.soon()
    wait_for(lambda: "The store cannot be read" not in client.get("/", **BASE).text)


def test_empty_store_and_first_look_are_told(tmp_path, wait_for):
    with History(tmp_path / "empty.db"):
        pass
    found = Refresher(Board(str(tmp_path / "empty.db"), SETTINGS), 3600.0)
    client = create_app(found).test_client()
    assert "The history is being read" in client.get("/", **BASE).text
    found.start()
    wait_for(lambda: found.words.startswith("last read"))
    found.stop()
    assert (
        "being read" in (page := client.get("/", **BASE).text)
        or "This history holds no trip" in page
    )


class Broken:
    """A board that fails in one way after the other."""

    def __init__(self, board, error):
        self.store, self.view, self._error = board.store, board.view, error

    def refresh(self):
        raise self._error


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError("no room"), "could not be computed: RuntimeError: no room"),
        (SystemExit(3), "is no longer read (SystemExit: 3): start suspnet-serve again"),
    ],
)
def test_refresher_that_fails_or_dies_is_told_on_every_page(refresher, error, words, wait_for):
    broken = Refresher(Broken(refresher.board, error), 3600.0)
    broken.start()
    wait_for(lambda: broken.fault)
    client = create_app(broken).test_client()
    wait_for(lambda: words in client.get("/", **BASE).text)
    assert words in client.get("/plan", **BASE).text
    broken.stop()


GERMAN = {"Accept-Language": "de-AT, de;q=0.9, en;q=0.5"}


def test_pages_are_in_the_language_of_the_browser(client, refresher):
    page = client.get("/", headers=GERMAN, **BASE).text
    assert '<html lang="de">' in page
    assert "4 Federungen: 2 mit Eingriff, 1 anzusehen, 1 ohne Alarm." in page
    name = name_of(refresher.board.view, WORN)
    worn = client.get(f"/suspension/{name}", headers=GERMAN, **BASE).text
    assert "sank um " in worn.replace("\N{NO-BREAK SPACE}", " ")
    assert "vorn links" in page
    assert "Dämpfung des Sekundärdämpfers" in worn
    figure = client.get(f"/suspension/{name}/trend.svg", headers=GERMAN, **BASE)
    assert figure.mimetype == "image/svg+xml"
    assert "Laufleistung" in figure.text
    assert "Laufleistung" not in client.get(f"/suspension/{name}/trend.svg", **BASE).text
    assert "window.evil" not in re.sub("&lt;script&gt;window.evil", "", page)
    missing = client.get("/suspension/none", headers=GERMAN, **BASE)
    assert "Diese Federung gibt es in dieser Historie nicht." in missing.text
    assert (
        "There is no such suspension in this history." in client.get("/suspension/no", **BASE).text
    )
    assert '<html lang="en">' in client.get("/", headers={"Accept-Language": "fr"}, **BASE).text


def test_language_can_be_fixed_but_programs_are_answered_in_english(refresher):
    client = create_app(refresher, language="de").test_client()
    assert "Aktive Alarme" in client.get("/", headers={"Accept-Language": "en"}, **BASE).text
    alarms = client.get("/api/v1/alarms", headers=GERMAN, **BASE)
    assert "below the act limit" in alarms.text
    with pytest.raises(ValueError, match="`language` must be one of en, de, got 'fr'"):
        create_app(refresher, language="fr")


def test_fleet_names_dead_and_failing_sensors(tmp_path):
    def health(i):
        return {
            "body left": SensorHealth(faulty=0.0 if i < 25 else 0.2),
            "body right": SensorHealth(faulty=0.0 if i < 28 else 1.0),
        }

    results = [
        replace(one, quality=replace(one.quality, sensors=sensors_text(health(i))))
        for i, one in enumerate(trips(HEALTHY))
    ]
    with History(tmp_path / "fleet.db") as store:
        store.write(results)
    board = Board(str(tmp_path / "fleet.db"), SETTINGS)
    board.refresh()
    client = create_app(Refresher(board, 3600.0)).test_client()
    dead = "dead and left out: body right (on 2 of 30 trips)"
    failing = "sensor body left: drop-outs in 20 % of the trip"
    assert board.view.rows[0]["sensors"] == f"{dead}; {failing}"
    page = client.get("/", headers=GERMAN, **BASE).text
    (german,) = re.findall(r"<small>(Sensoren: .*?)</small>", page)
    assert german.count("Wagenkasten, ") == 2
    (answered,) = client.get("/api/v1/suspensions", **BASE).json["items"]
    assert answered["sensors"] == f"{dead}; {failing}"
