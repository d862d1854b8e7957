"""Names from the header of a reverse proxy: whose is believed, and what viewers may do."""

import re

import pytest
from served_fleet import FAILED, SETTINGS, name_of
from test_api import BASE, BEARER, TOKEN, client

from suspnet.depot.web.access import Access
from suspnet.trains.history import History
from suspnet.trains.pages.board import Board

JUERGEN = "Jürgen".encode().decode("latin-1")  # as a server gives the bytes of a header
LOGIN = Access("X-Remote-User", ["10.0.0.5", "192.168.7.0/24"], ["Kim Li", "Jürgen"], TOKEN)


def get(board, path, peer="10.0.0.5", **headers):
    return client(board, LOGIN, peer).get(path, base_url=BASE, headers=headers)


@pytest.mark.parametrize(
    ("peer", "name", "code"),
    [
        ("10.0.0.5", "Kim Li", 200),
        ("192.168.7.200", "anybody", 200),
        ("10.0.0.6", "Kim Li", 403),  # not the proxy
        ("127.0.0.1", "Kim Li", 403),
        ("10.0.0.5", "", 403),
        ("10.0.0.5", "Eve,Kim Li", 403),  # two headers, joined
        ("10.0.0.5", "x" * 81, 403),
    ],
)
def test_names_are_believed_of_the_proxy_alone(filled, peer, name, code):
    for path in ("/", "/api/v1/suspensions", "/plan", "/state"):
        assert get(filled[1], path, peer, **{"X-Remote-User": name}).status_code == code


def test_a_login_at_the_proxy_by_a_password_is_no_wrong_token(filled):
    """nginx passes the visitor's own Authorization on."""
    sent = {"Authorization": "Basic S2ltOng=", "X-Remote-User": "Kim Li"}
    assert get(filled[1], "/api/v1/suspensions", **sent).status_code == 200
    del sent["X-Remote-User"]
    assert get(filled[1], "/api/v1/suspensions", **sent).status_code == 403


def test_other_headers_say_nothing_about_the_peer(filled):
    sent = {"X-Remote-User": "Kim Li", "X-Forwarded-For": "10.0.0.5", "Forwarded": "for=10.0.0.5"}
    assert get(filled[1], "/", "10.0.0.6", **sent).status_code == 403


def test_without_a_header_configured_names_are_ignored(filled):
    visitor, name = client(filled[1]), name_of(filled[1].view, FAILED)
    sent = {"X-Remote-User": "Eve"}
    page = visitor.get(f"/suspension/{name}", base_url=BASE, headers=sent).text
    assert "Eve" not in page
    assert "Your name" in page


def sent_form(visitor, name, **changes):
    """Send the form that an engineer gets of the page of a suspension, perhaps as another one."""
    page = visitor.get(
        f"/suspension/{name}", base_url=BASE, headers={"X-Remote-User": JUERGEN}
    ).text
    token = re.search(r'csrf_token" value="([^"]+)', page)[1]
    content = {"csrf_token": token, "parameter": "k_s", "cause": "limit", "severity": "act"}
    address = f"/suspension/{name}/acknowledge"
    return page, visitor.post(address, data=content | {"by": "Eve"}, base_url=BASE, **changes)


def test_viewer_sees_no_form_and_cannot_send_one(filled):
    path, board = filled
    visitor, name = client(board, LOGIN, "10.0.0.5"), name_of(board.view, FAILED)
    ada = {"X-Remote-User": "Ada"}
    page = visitor.get(f"/suspension/{name}", base_url=BASE, headers=ada).text
    assert '<form method="post"' not in page
    assert "Ada, who may look but not acknowledge alarms" in page
    _, sent = sent_form(visitor, name, headers=ada)
    assert sent.status_code == 403
    assert "Ada may look" in sent.text
    with History(path) as store:
        assert store.all_acknowledgements() == {}


def test_engineer_acknowledges_under_the_name_of_the_proxy(own_store):
    board = Board(str(own_store), SETTINGS)
    board.refresh()
    visitor, name = client(board, LOGIN, "10.0.0.5"), name_of(board.view, FAILED)
    page, sent = sent_form(visitor, name, headers={"X-Remote-User": JUERGEN})
    assert "You acknowledge it as Jürgen" in page
    assert sent.status_code == 302
    with History(own_store) as store:
        assert [one.by for one in store.acknowledgements("am96", FAILED)] == ["Jürgen"]


def test_programs_need_the_token_and_no_name(filled):
    board = filled[1]
    assert get(board, "/api/v1/alarms", "8.8.8.8", **BEARER).status_code == 200
    assert get(board, "/", "8.8.8.8", **BEARER).status_code == 403


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"user_header": "X-Remote-User"}, "whose X-Remote-User is believed"),
        ({"user_header": "X Remote", "trusted_proxies": ["127.0.0.1"]}, "name of a header"),
        ({"user_header": "X-U", "trusted_proxies": ["proxy"]}, "addresses or networks: 'proxy'"),
        ({"engineers": ["Kim"]}, "need `user_header`"),
        ({"token": "short"}, "24 to 200"),
        ({"token": "with a space in the middle of it"}, "no space"),
    ],
)
def test_bad_settings_are_refused(given, words):
    with pytest.raises(ValueError, match=words):
        Access(**given)
    assert TOKEN not in repr(LOGIN)
