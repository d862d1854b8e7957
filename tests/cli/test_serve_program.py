"""suspnet-serve as a user runs it: mistakes are one line, Ctrl-C ends it."""

import os
import re
import signal
import socket
import time
import urllib.request
from pathlib import Path

import pytest
import yaml
from cli_runner import typed
from forked import started
from served_fleet import fill

from suspnet.cli import evaluate, serve
from suspnet.cli.config_files import CONFIGS
from suspnet.trains.history import History

WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
ENDS = [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)]
"""SIGTERM comes in the middle of a request by default."""


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return fill(tmp_path_factory.mktemp("serve") / "fleet.db")


def listening(process, output):
    """Return the address of a program once it says that it listens there."""
    deadline = time.monotonic() + 60
    while not (found := re.search(r"http://127\.0\.0\.1:\d+/", output.read_text())):
        assert process.is_alive()
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return found[0]


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
    login = "user_header=X-User", "trusted_proxies=[10.0.0.5]"
    said = refused(store, "host=0.0.0.0", *login)
    assert "no login" not in said
    assert "give open_to_network=true" in said
    assert "Give hosts=[NAME, ...]" in refused(store, "host=0.0.0.0", "open_to_network=true")
    assert "must be an IPv4 address or a name" in refused(store, "host='::1'")
    assert "`today` must be a day" in refused(store, "today=soon")
    assert "`url_prefix` must be the path" in refused(store, "url_prefix=fleet")


def test_mistakes_about_who_may_do_what_are_one_line(refused, path, tmp_path, monkeypatch):
    store = f"store={path}"
    assert "whose X-User is believed?" in refused(store, "user_header=X-User")
    assert "`engineers` is a list" in refused(store, "engineers=Kim")
    monkeypatch.setenv(f"{serve.TOKEN_VARIABLE}_FILE", "none.token")
    assert "No such file" in refused(store)
    (tmp_path / "api.token").write_text("short\n")
    monkeypatch.setenv(f"{serve.TOKEN_VARIABLE}_FILE", str(tmp_path / "api.token"))
    assert "24 to 200 ASCII characters" in refused(store)


@pytest.mark.parametrize(
    ("module", "where", "arguments"),
    [(serve, "serve", ()), (evaluate, "write_maintenance", ("study=maintenance",))],
)
def test_limits_of_a_users_own_vehicle_are_found(
    path, tmp_path, monkeypatch, module, where, arguments
):
    shipped = yaml.safe_load((Path(CONFIGS) / "vehicle" / "am96.yaml").read_text())
    limits = {"k_p": {"notice": [0.97, 1.03], "act": [0.95, 1.05], "why": "our rule 7"}}
    (tmp_path / "mine" / "vehicle").mkdir(parents=True)
    own = yaml.safe_dump(shipped | {"name": "metro", "limits": limits})
    (tmp_path / "mine" / "vehicle" / "metro.yaml").write_text(own)
    given = []
    monkeypatch.setattr(module, where, lambda *args: given.extend(args) or [])
    named = ("--config-dir", "mine", *arguments, f"store={path}")
    ended = typed(module, *named, cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    settings = given[0].settings if module is serve else given[2]
    assert settings.limits_of("metro")["k_p"].why == "our rule 7"
    assert settings.limits_of("am96")["k_p"].act == (0.8, 1.25)


def test_port_that_is_taken_is_one_line(refused, path):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        assert f"127.0.0.1:{port}: Address already in use" in refused(
            f"store={path}", f"port={port}"
        )


def test_missing_package_names_the_extra(refused, path, monkeypatch):
    monkeypatch.setattr(
        "importlib.util.find_spec", lambda name: None if name == "waitress" else name
    )
    assert 'waitress is missing: pip install -e ".[live]"' in refused(f"store={path}")


@pytest.mark.representatives(1)
@pytest.mark.parametrize(("number", "code"), ENDS)
def test_pages_are_served_until_a_signal(path, tmp_path, number, code):
    with started(serve, f"store={path}", "port=0", cwd=tmp_path) as (process, output, errors):
        with urllib.request.urlopen(listening(process, output), timeout=60) as answer:
            assert "<h1>Fleet</h1>" in answer.read().decode()
        os.kill(process.pid, number)
        process.join(60)
        printed, wrong = output.read_text(), errors.read_text()
    assert process.exitcode == code
    assert "Traceback" not in printed
    assert wrong == f"{WORDS[number]}: the pages are no longer served\n"
    with History(path) as store:
        assert len(store.places()) == 4
