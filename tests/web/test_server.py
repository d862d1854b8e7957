"""The server answers while connections hang, dribble, or send too much, and below a path."""

import http.client
import json
import re
import socket
import threading
import time
import urllib.request
from contextlib import ExitStack, closing, contextmanager
from urllib.parse import urlencode, urljoin, urlsplit

import pytest
from flask import Flask
from live_frames import until
from served_fleet import served
from waitress import wasyncore

from suspnet.depot.web.app import MAX_CONNECTIONS, http_server

HEAD = b"POST /suspension/x/acknowledge HTTP/1.1\r\nHost: localhost\r\nContent-Length: 9000\r\n\r\n"
SENT = {"idle": b"", "half a head": b"GET / HTTP/1.1\r\nHost: local", "half a body": HEAD + b"a=1"}

PREFIX = "/fleet"
"""Path at which a reverse proxy shows the pages; requests without it work, too."""
ADDRESS = re.compile(r'(?:href|src|action|data-state)="([^"#]+)"')


@pytest.fixture(scope="module")
def site(filled, tmp_path_factory):
    path = tmp_path_factory.mktemp("served") / "fleet.db"  # one test acknowledges an alarm
    path.write_bytes(filled[0].read_bytes())
    with served(path, 3600.0, prefix=PREFIX) as (address, refresher):
        assert until(lambda: refresher.board.view.is_complete, 60)
        yield address


def connection(site):
    host, port = site.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=10)


@contextmanager
def hanging(site, number, sent):
    """Hold connections open that never end their request."""
    with ExitStack() as stack:
        for _ in range(number):
            stack.enter_context(connection(site)).sendall(sent)
        yield


def seconds_of_page(site, path="/"):
    """Return how long a page takes a new client, [s]."""
    begin = time.monotonic()
    with urllib.request.urlopen(site + path, timeout=8) as answer:
        assert answer.status == 200
        answer.read()
    return time.monotonic() - begin


def answer_to(site, content, wait_s=10):
    """Send bytes and return all that comes back, with pauses of less than some time."""
    found = b""
    with connection(site) as one:
        one.sendall(content)
        one.settimeout(wait_s)
        try:
            while part := one.recv(65_536):
                found += part
        except (ConnectionResetError, TimeoutError):
            pass
    return found


@pytest.mark.parametrize("sent", SENT)
def test_pages_come_while_connections_hang(site, sent):
    with hanging(site, MAX_CONNECTIONS + 20, SENT[sent]):
        assert seconds_of_page(site) < 5
        assert seconds_of_page(site, "/state") < 5


def test_answered_connection_is_not_closed_for_a_few_others(site):
    mine = http.client.HTTPConnection(site.removeprefix("http://"), timeout=10)
    mine.connect()
    first = mine.sock
    with closing(mine), hanging(site, 20, b""):
        for _ in range(3):
            mine.request("GET", "/state")
            assert mine.getresponse().read()
            assert mine.sock is first


def test_too_large_requests_are_refused_while_they_come(site):
    head = b"POST /x HTTP/1.1\r\nHost: localhost\r\nContent-Length: 900000000\r\n\r\n"
    assert b" 413 " in answer_to(site, head + bytes(1000)).split(b"\r\n")[0]
    large = b"GET / HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 16_400
    assert b" 431 " in answer_to(site, large).split(b"\r\n")[0]


@contextmanager
def served_answer(size, timeout_s):
    """Serve an answer of some size with two workers, and give up on clients after a time."""
    app = Flask("large")
    app.add_url_rule("/", "large", lambda: bytes(size))
    app.add_url_rule("/state", "small", lambda: "well")
    server = http_server(app, socket.create_server(("127.0.0.1", 0)), 2)
    server.adj.channel_timeout = server.adj.cleanup_interval = timeout_s
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.effective_port}", server
    finally:
        server.task_dispatcher.shutdown(timeout=5)
        server.trigger.pull_trigger(lambda: wasyncore.close_all(server._map, ignore_all=True))
        thread.join(5)


GET = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"


def test_answers_that_nobody_reads_block_no_other_and_are_closed():
    with served_answer(5_000_000, 1) as (site, server), hanging(site, 8, GET * 8):
        for _ in range(3):
            assert seconds_of_page(site, "/state") < 5
        assert until(lambda: not server.active_channels, 20)


def test_one_request_of_a_connection_may_wait_and_more_end_it():
    with served_answer(10, 30) as (site, _):
        assert answer_to(site, GET * 2, 0.5).count(b" 200 ") == 2
        found = answer_to(site, GET * 8)
    assert found.count(b" 200 ") == 2
    assert found.count(b"Connection: close") == 1


def ask_behind(site, path, strips, body=None, **headers):
    """Ask as a proxy does that strips PREFIX or passes it on; return the answer and its text."""
    with closing(http.client.HTTPConnection(site.removeprefix("http://"), timeout=10)) as one:
        method = "POST" if body else "GET"
        one.request(method, path.removeprefix(PREFIX) if strips else path, body, headers)
        answer = one.getresponse()
        return answer, answer.read().decode("utf-8", "replace")


def kind_of(address):
    """Return the address itself, or of a figure its name."""
    path = urlsplit(address).path
    return path.rpartition("/")[2] if path.endswith(".svg") else address


@pytest.mark.parametrize("strips", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_every_address_of_every_page_works_below_the_path_of_a_proxy(site, strips):
    waiting, seen = {f"{PREFIX}/", f"{PREFIX}/no-such-page"}, set()
    while waiting:
        path = waiting.pop()
        seen.add(path)
        answer, text = ask_behind(site, path, strips)
        assert path.startswith(f"{PREFIX}/")
        assert answer.status == (404 if "no-such-page" in path else 200), path
        if answer.headers.get_content_type() == "text/html":
            linked = {urljoin(path, one.replace("&amp;", "&")) for one in ADDRESS.findall(text)}
            # figures take longest: one of each kind is enough
            linked = {one for one in linked if kind_of(one) not in map(kind_of, seen | waiting)}
            waiting |= {one for one in linked - seen if "/acknowledge" not in one}
    ends = ("trend.svg", "live.js", "responses.svg")
    assert all(any(urlsplit(one).path.endswith(f"/{end}") for one in seen) for end in ends)
    _, text = ask_behind(site, f"{PREFIX}/api/v1/alarms", strips)
    assert json.loads(text)["items"]


def test_a_form_leads_back_below_the_path_of_a_proxy(site):
    _, text = ask_behind(site, f"{PREFIX}/", True)
    page = re.search(rf'href="({PREFIX}/suspension/\w+)#', text)[1]  # that of an alarm, to its form
    answer, text = ask_behind(site, page, True)
    action = next(one for one in ADDRESS.findall(text) if one.endswith("/acknowledge"))
    form = re.findall(r'name="(\w+)"[^>]*?value="([^"]*)"', text)
    cookie = answer.headers["Set-Cookie"]
    assert f"Path={PREFIX}" in cookie
    kind = {"Content-Type": "application/x-www-form-urlencoded"}
    body = urlencode(dict(form) | {"by": "Kim"})
    answer, _ = ask_behind(site, action, True, body, Cookie=cookie.partition(";")[0], **kind)
    assert answer.status == 302
    assert answer.headers["Location"] == page
