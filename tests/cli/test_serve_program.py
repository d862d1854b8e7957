"""suspnet-serve as a user runs it: mistakes are one line, Ctrl-C ends it."""

import os
import re
import signal
import socket
import time
import urllib.request

import pytest
from cli_runner import typed
from forked import started
from served_fleet import fill

from suspnet.cli import serve
from suspnet.history import History


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return fill(tmp_path_factory.mktemp("serve") / "fleet.db")


@pytest.fixture
def refused(tmp_path):
    """Run the program with arguments and return its one line."""

    def run(*arguments):
        ended = typed(serve, *arguments, cwd=tmp_path)
        assert ended.returncode == 1
        (line,) = ended.stderr.splitlines()
        return line

    return run


def test_mistakes_are_one_line(refused, path, tmp_path):
    store = f"store={path}"
    assert "which history? Give store=FILE" in refused()
    assert "there is no folder" in refused("store=nowhere/fleet.db")
    (tmp_path / "words.db").write_text("no store at all, but words")
    assert "words.db" in refused("store=words.db")
    assert "`port` must be" in refused(store, "port=70000")
    assert "`refresh_s` must be" in refused(store, "refresh_s=0")
    assert "there is no login; give open_to_network=true" in refused(store, "host=0.0.0.0")
    assert "Give hosts=[NAME, ...]" in refused(store, "host=0.0.0.0", "open_to_network=true")
    assert "must be an IPv4 address or a name" in refused(store, "host='::1'")
    assert "`today` must be a day" in refused(store, "today=soon")


def test_port_that_is_taken_is_one_line(refused, path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert f"127.0.0.1:{port}: Address already in use" in refused(
            f"store={path}", f"port={port}"
        )


def test_missing_package_names_the_extra(refused, path, monkeypatch):
    monkeypatch.setattr(serve, "find_spec", lambda name: None if name == "plotly" else name)
    assert 'plotly is missing: pip install "suspnet[live]"' in refused(f"store={path}")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 0), (signal.SIGTERM, 143)])
def test_pages_are_served_until_a_signal(path, tmp_path, number, code):
    with started(serve, f"store={path}", "port=0", cwd=tmp_path) as (process, output, errors):
        deadline = time.monotonic() + 60
        while not (found := re.search(r"http://127\.0\.0\.1:\d+/", output.read_text())):
            assert process.is_alive(), errors.read_text()
            assert time.monotonic() < deadline
            time.sleep(0.05)
        with urllib.request.urlopen(found[0], timeout=60) as answer:
            assert "<h1>Fleet</h1>" in answer.read().decode()
        os.kill(process.pid, number)
        process.join(60)
        printed, wrong = output.read_text(), errors.read_text()
    assert process.exitcode == code
    assert "Traceback" not in printed + wrong
    assert ("ended" in printed) == (code == 0)
    with History(path) as store:
        assert len(store.places()) == 4
