"""The pages of bogies of which each part is read, and those of a fleet without any."""

import re

import pytest
from served_fleet import HEALTHY, SETTINGS, bogie_trips, name_of, trips

from suspnet.depot.web.app import create_app
from suspnet.ground.parameters import BOGIE_PARTS
from suspnet.ground.records import Place
from suspnet.trains.history import History
from suspnet.trains.pages.board import Board, Refresher

BASE = {"base_url": "http://127.0.0.1:8050"}
WORN, CALM = Place("", "leading", "", "7", "1"), Place("", "leading", "", "7", "2")


def client_of(path, results):
    """Return the client and the view of a store that was read once."""
    with History(path) as store:
        store.write(results)
    board = Board(str(path), SETTINGS)
    board.refresh()
    return create_app(Refresher(board, 3600.0)).test_client(), board.view


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    worn = bogie_trips(WORN, 1, {"c_p_axle2_left": lambda i: 0.6}, n_trips=8)
    calm = bogie_trips(CALM, 2, n_trips=4)
    path = tmp_path_factory.mktemp("bogies") / "fleet.db"
    return client_of(path, [*worn, *calm, *trips(HEALTHY, 3, n_trips=4)])


def test_fleet_draws_the_worst_bogies_with_links_to_their_trends(site):
    client, view = site
    page = client.get("/", **BASE).text
    assert page.count('<svg class="bogie"') == 2  # the healthy one as well
    addresses = [f"/suspension/{name_of(view, one)}#trend-" for one in (WORN, CALM)]
    links = re.findall(r'<a href="([^"]+)" class="part ', page)
    assert sorted(links) == sorted(one + name for one in addresses for name in BOGIE_PARTS)
    assert links[0].startswith(addresses[0])  # the worst one first
    assert "Not drawn" not in page
    assert "replace at the visit of 2026-03-15" in page
    assert not re.search(r"<script(?! src=)|\son\w+=|style=", page)
    none = client.get("/?severity=none", **BASE).text
    assert none.count('<svg class="bogie"') == 1
    assert "None of the twelve parts has an alarm or has worn." in none


def test_suspension_has_a_figure_of_each_part_those_without_alarm_folded(site):
    client, view = site
    name = name_of(view, WORN)
    page = client.get(f"/suspension/{name}", **BASE).text
    targets = re.findall(r'href="#(trend-[^"]+)" class="part ', page)
    assert sorted(targets) == sorted(f"trend-{part}" for part in BOGIE_PARTS)
    places = {one: page.index(f'<figure id="{one}"') for one in targets}
    folded = page.index('<details id="calm">')
    assert {one for one in targets if places[one] < folded} == {"trend-c_p_axle2_left"}
    assert not re.search(r"<script(?! src=)|\son\w+=|style=", page)
    addresses = [
        one.replace("&amp;", "&") for one in re.findall(r'<img src="([^"]+of=[^"]+)', page)
    ]
    assert len(addresses) == len(BOGIE_PARTS)
    for address in addresses[:2]:
        assert b"<svg" in client.get(address, **BASE).data
    assert client.get(f"/suspension/{name}/trend.svg?of=k_p", **BASE).status_code == 404


def test_suspension_without_parts_draws_none(site):
    client, view = site
    page = client.get(f"/suspension/{name_of(view, HEALTHY)}", **BASE).text
    assert "<svg" not in page
    assert 'id="trend-plot"' in page
