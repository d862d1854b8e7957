"""Requests of random methods, paths, headers and bodies: each gets an answer, none an error."""

import re
import time
import urllib.request

import numpy as np
import pytest
from served_fleet import FAILED, fill, name_of, served
from test_server import answer_to

METHODS = (
    "GET",
    "GET",
    "GET",
    "HEAD",
    "POST",
    "PUT",
    "DELETE",
    "OPTIONS",
    "TRACE",
    "PATCH",
    "X\xff",
)
PARTS = (
    *("", "/", "plan", "state", "suspension", "acknowledge", "trend.json", "responses.json"),
    *("files", "calendar.svg", "..", ".", "%2e%2e", "%2f", "%00", "%ff", "%", "%zz", "a" * 3000),
    *("\\", "//evil.example", "{{7*7}}", "<script>", "é", "\x01", ";", "*", "'", '"', "static"),
)
NAMES = (
    "train",
    "severity",
    "rows",
    "of",
    "by",
    "words",
    "parameter",
    "cause",
    "csrf_token",
    "%ff",
)
VALUES = (
    *("", "12", "act", "all", "x" * 5000, "%00", "%ff", "\xff", "<script>", "' OR 1=1 --", "k_s"),
    *("limit", "9" * 400, "%F0%9F%92%A9", "a&b=c", "=", "+", "NaN", "-1", "__proto__", "[]"),
)
HEADERS = (
    *(
        "Host: localhost",
        "Host: evil.example",
        "Host:",
        "Host: [::1",
        "Host: a:99999",
        "Host: \xff",
    ),
    *("Content-Type: application/x-www-form-urlencoded", "Content-Type: multipart/form-data"),
    *(
        "Content-Type: multipart/form-data; boundary=x",
        "Content-Type: \xff",
        "Accept-Encoding: gzip",
    ),
    *("Accept-Encoding: gzip;q=nan", "Accept-Encoding: ,,;q=", "Cookie: suspnet=x.y.z"),
    *("Cookie: suspnet=" + "a" * 3000, "Cookie: \xff=\xfe; ;", "Transfer-Encoding: chunked"),
    *("Content-Length: 5", "Content-Length: -1", "Content-Length: x", "Expect: 100-continue"),
    *("Connection: close", "Connection: \xff", "X-Forwarded-For: 1.2.3.4", "Range: bytes=0-1"),
    *("Referer: http://evil.example/", "Origin: null", "no colon", ": empty", "If-None-Match: *"),
    *("Referer: http://[", "Upgrade: websocket", "Authorization: Basic \xff", " folded: x"),
)
BODIES = (
    "",
    "a=b",
    "csrf_token=x&by=%ff",
    "--x\r\n\r\n--x--",
    "5\r\nhello\r\n0\r\n\r\n",
    "zz\r\n",
    "\0" * 99,
)
VERSIONS = (*("HTTP/1.1",) * 20, "HTTP/1.0", "HTTP/9.9", "", "HTTP/1.1 x")


def request(rng, names, cookie, token):
    """Return the bytes of a request; most have a good host, and many forms a token that holds."""

    def some(texts, most):
        return [str(one) for one in rng.choice(np.array(texts, object), rng.integers(0, most))]

    path = "/" + "/".join(some(PARTS, 4))
    if rng.random() < 0.5:
        ends = ("", "/acknowledge", "/trend.json", "/responses.json")
        path = f"/suspension/{rng.choice(names)}{rng.choice(ends)}"
    query = "&".join(f"{rng.choice(NAMES)}={value}" for value in some(VALUES, 4))
    hosts = HEADERS[:6] if rng.random() < 0.1 else ["Host: 127.0.0.1"]
    headers = [str(rng.choice(np.array(hosts, object)))]
    headers += some(HEADERS[6:], 4 if rng.random() < 0.5 else 1)
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


def ask_for(seconds, most, path, seed, caplog, wait_s=0.5):
    """Send random requests for a while, and check every answer."""
    rng = np.random.default_rng(seed)
    counts, begin = {}, time.monotonic()
    with served(path, 3600.0) as (site, refresher):
        while not refresher.board.view.is_complete:
            assert time.monotonic() - begin < 60
            time.sleep(0.05)
        names, begin = list(refresher.board.view.keys), time.monotonic()
        cookie, token = session(site, name_of(refresher.board.view, FAILED))
        for _ in range(most):
            if time.monotonic() - begin > seconds:
                break
            sent = request(rng, names, cookie, token)
            begun = time.monotonic()
            code = answer_to(site, sent, wait_s).split(b"\r\n")[0][9:12].decode()
            assert time.monotonic() - begun < 10, sent
            assert not code.startswith("500"), sent
            code = code or "none: it waits for more"
            counts[code] = counts.get(code, 0) + 1
        assert answer_to(site, b"GET /state HTTP/1.0\r\nHost: localhost\r\n\r\n")[9:12] == b"200"
    assert not [one for one in caplog.records if one.exc_info], caplog.text
    print(f"{sum(counts.values())} requests, answers {dict(sorted(counts.items()))}")


def test_requests_give_no_error_of_the_program(tmp_path, caplog):
    ask_for(10, 30, fill(tmp_path / "fleet.db"), 0, caplog, wait_s=0.05)


@pytest.mark.slow
def test_many_requests_give_no_error_of_the_program(tmp_path, caplog):
    ask_for(200, 10**6, fill(tmp_path / "fleet.db"), 1, caplog)
