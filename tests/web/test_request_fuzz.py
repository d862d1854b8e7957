"""Requests of random methods, paths, headers and bodies: each gets an answer, none an error."""

import re
import time
import urllib.request

import numpy as np
import pytest
from live_frames import until
from served_fleet import FAILED, name_of, served
from test_server import answer_to

METHODS = (*"GET GET GET HEAD POST PUT DELETE OPTIONS TRACE PATCH".split(), "X\xff")
PARTS = (
    *("", "/", "plan", "state", "suspension", "acknowledge", "trend.svg", "responses.svg"),
    *("files", "calendar.svg", "..", ".", "%2e%2e", "%2f", "%00", "%ff", "%", "%zz", "a" * 3000),
    *("\\", "//evil.example", "{{7*7}}", "<script>", "é", "\x01", ";", "*", "'", '"', "static"),
)
NAMES = "train severity rows of by words parameter cause csrf_token %ff".split()
VALUES = (
    *("", "12", "act", "all", "x" * 5000, "%00", "%ff", "\xff", "<script>", "' OR 1=1 --", "k_s"),
    *("limit", "9" * 400, "%F0%9F%92%A9", "a&b=c", "=", "+", "NaN", "-1", "__proto__", "[]"),
)
HOSTS = ("localhost", "evil.example", "", "[::1", "a:99999", "\xff")
HEADERS = (
    *("Content-Type: application/x-www-form-urlencoded", "Content-Type: multipart/form-data"),
    *("Content-Type: multipart/form-data; boundary=x", "Content-Type: \xff"),
    *("Accept-Encoding: gzip", "Accept-Encoding: gzip;q=nan", "Accept-Encoding: ,,;q="),
    *("Cookie: suspnet=x.y.z", "Cookie: suspnet=" + "a" * 3000, "Cookie: \xff=\xfe; ;"),
    *("Transfer-Encoding: chunked", "Content-Length: 5", "Content-Length: -1", "Content-Length: x"),
    *("Expect: 100-continue", "Connection: close", "Connection: \xff", "Range: bytes=0-1"),
    *("Referer: http://evil.example/", "Origin: null", "no colon", ": empty", "If-None-Match: *"),
    *("Referer: http://[", "Upgrade: websocket", "Authorization: Basic \xff", " folded: x"),
)
BODIES = ("", "a=b", "csrf_token=x&by=%ff", "--x\r\n\r\n--x--", "5\r\nhello\r\n0\r\n\r\n", "zz\r\n")
VERSIONS = (*("HTTP/1.1",) * 20, "HTTP/1.0", "HTTP/9.9", "", "HTTP/1.1 x")


def request(rng, names, cookie, token):
    """Return the bytes of a request; most have a good host, and many forms a token that holds."""

    def some(texts, most):
        return [str(one) for one in rng.choice(np.array(texts, object), rng.integers(0, most))]

    path = "/" + "/".join(some(PARTS, 4))
    if rng.random() < 0.5:
        ends = ("", "/acknowledge", "/trend.svg", "/responses.svg")
        path = f"/suspension/{rng.choice(names)}{rng.choice(ends)}"
    query = "&".join(f"{rng.choice(NAMES)}={value}" for value in some(VALUES, 4))
    headers = [f"Host: {rng.choice(HOSTS) if rng.random() < 0.1 else '127.0.0.1'}"]
    headers += some(HEADERS, 4 if rng.random() < 0.5 else 1)
    body, method = "".join(some(BODIES, 3)), rng.choice(METHODS)
    if rng.random() < 0.2:
        form = "&".join(f"{rng.choice(NAMES[3:8])}={value}" for value in some(VALUES, 7))
        good = "parameter=k_s&cause=limit&severity=act" if rng.random() < 0.5 else ""
        method, path = "POST", f"/suspension/{rng.choice(names)}/acknowledge"
        body = f"csrf_token={token}&{good}&{form}"
        headers += [f"Cookie: {cookie}", "Content-Type: application/x-www-form-urlencoded"]
        headers += ["Referer: http://127.0.0.1/"] * (rng.random() < 0.5)
    if rng.random() < 0.9:
        headers.append(f"Content-Length: {len(body)}")
    line = f"{method} {path}{'?' + query if query else ''} {rng.choice(VERSIONS)}"
    text = "\r\n".join([line, *headers, "Connection: close", "", body])
    return text.encode("latin-1", "replace")


def session(site, name):
    """Return cookie and token of a visitor of a suspension's page."""
    with urllib.request.urlopen(f"{site}/suspension/{name}", timeout=20) as answer:
        cookie = answer.headers["Set-Cookie"].split(";")[0]
        return cookie, re.search(r'csrf_token" value="([^"]+)', answer.read().decode())[1]


@pytest.mark.parametrize("n", [30, pytest.param(2000, marks=pytest.mark.slow)])
def test_requests_give_no_error_of_the_program(filled, caplog, n):
    rng = np.random.default_rng(n)
    with served(filled[0], 3600.0) as (site, refresher):
        until(lambda: refresher.board.view.is_complete, 60)
        names = list(refresher.board.view.keys)
        cookie, token = session(site, name_of(refresher.board.view, FAILED))
        for _ in range(n):
            sent, begin = request(rng, names, cookie, token), time.monotonic()
            status = answer_to(site, sent, 0.05).split(b"\r\n")[0]
            assert time.monotonic() - begin < 10, sent
            assert not status[9:].startswith(b"500"), sent
        assert answer_to(site, b"GET /state HTTP/1.0\r\nHost: localhost\r\n\r\n")[9:12] == b"200"
    assert not [record for record in caplog.records if record.exc_info], caplog.text
