"""Alarms reach people: once by id, also after failures and kills; nothing is lost."""

import json
import logging
import multiprocessing
import os
import shutil
import signal
import socket
import sqlite3
import ssl
import subprocess
import threading
from contextlib import closing, contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from email import message_from_bytes, policy

import pytest
from empty_stores import KINDS, empty_store
from live_frames import until
from notified import (
    ACT,
    FIRST,
    KEY,
    NOTICE,
    SECOND,
    VEHICLE,
    fill,
    notify_forever,
    receiving,
    rules_file,
)
from trip_records import trip

from suspnet.depot.live import notifier as notifier_module
from suspnet.depot.live.channels import AddressError, DeliveryError, Webhook
from suspnet.depot.live.notifier import Notifier, read_rules
from suspnet.ground.findings import parts_of, together
from suspnet.ground.parameters import Severity
from suspnet.trains.fits.worn_parts import WornPart
from suspnet.trains.history import History, HistoryError, outbox
from suspnet.trains.history.outbox import LEASE_S
from suspnet.trains.pages.messages import text

NIGHT = datetime(2026, 3, 31, 3, tzinfo=UTC)
_DIGEST = {"kind": "digest", "id": "1", "day": "2026-03-31", "alarms": [], "n_suspensions": 0}
MESSAGE = outbox.Message("1", "kim", "m", "kim@example.org", "digest", _DIGEST, 0)


@pytest.fixture(autouse=True)
def _secrets(monkeypatch):
    monkeypatch.setenv("SUSPNET_WEBHOOK_SECRET", KEY)


@pytest.fixture
def _every_look(monkeypatch):
    """Look at the alarms also where no suspension changed."""
    monkeypatch.setattr(notifier_module, "LONGEST_LOOK_S", 0.0)


class Clock:
    def __init__(self):
        self.now = NIGHT

    def __call__(self):
        return self.now


class Recorder(list):
    """A channel that lists what it gets, and fails as often as it is asked to."""

    def __init__(self):
        self.n_failures, self.error = 0, DeliveryError("the server is down")

    def check(self, addresses):
        pass

    def send(self, message):
        if self.n_failures:
            self.n_failures -= 1
            raise self.error
        self.append(message)


@pytest.fixture(params=["sqlite"])
def told(request, tmp_path):
    """Store, notifier, its clock and the channel that records; digest at six o'clock UTC."""
    place = fill(empty_store(request.param, tmp_path))
    file = rules_file(
        tmp_path / "notify.json",
        {"hook": {"kind": "webhook", "url": "http://localhost:9/"}},
        {"workshop": {"channels": ["hook"]}},
    )
    rules = replace(read_rules(file), zone=UTC, channels={"hook": Recorder()})
    clock = Clock()
    with History(place) as store:
        yield store, Notifier(store, rules, clock), clock, rules.channels["hook"], rules


def states(message):
    return [(one["parameter"], one["state"]) for one in message.content["alarms"]]


@pytest.mark.usefixtures("_every_look")
def test_act_is_sent_at_once_and_a_notice_waits_for_the_digest(told):
    _, notifier, clock, got, _ = told
    assert notifier.once() == (1, 0)
    assert got[0].kind == "alarms"
    assert states(got[0]) == [("k_p", "new")]
    assert notifier.once() == (0, 0)
    clock.now += timedelta(hours=4)
    assert notifier.once() == (1, 0)
    assert states(got[1]) == [("k_p", "known"), ("c_s", "new")]
    assert len({one.id for one in got}) == 2


@pytest.mark.parametrize("told", KINDS, indirect=True)
def test_a_message_says_what_the_newest_trip_names_of_the_part(told):
    store, notifier, _, got, _ = told
    part, other = "c_p_axle2_left", "k_p_axle1_left"
    worn = together(WornPart((name,), 1e6, 0.93).finding for name in (part, other))
    store.write([trip(1, with_curves=False, place=SECOND, worn=worn)])
    store.keep_alarms(VEHICLE, SECOND, [replace(ACT, parameter=part, words="fell by 7 %")])
    assert notifier.once() == (1, 0)
    (entry,) = (one for one in got[0].content["alarms"] if one["parameter"] == part)
    assert [one["text"] for one in entry["findings"]] == ["fell by 7 %", str(parts_of(worn)[0])]
    assert "; damper of axle 2, left at 93 % of healthy" in text(got[0].content)


@pytest.mark.parametrize("told", KINDS, indirect=True)
@pytest.mark.usefixtures("_every_look")
def test_what_was_told_is_told_again_only_when_worse_cleared_or_raised_again(told):
    store, notifier, clock, got, _ = told
    notifier.once()
    # a late trip moves the start of an alarm: it is the same alarm
    store.keep_alarms(VEHICLE, FIRST, [replace(ACT, begin_km=9e3)])
    assert notifier.once() == (0, 0)
    store.keep_alarms(VEHICLE, SECOND, [replace(NOTICE, severity=Severity.ACT)])
    assert notifier.once() == (1, 0)
    assert states(got[-1]) == [("c_s", "new")]
    again = replace(ACT, begin_km=3e4)
    store.keep_alarms(VEHICLE, FIRST, [replace(ACT, end_km=2e4), again])
    assert notifier.once() == (1, 0)
    assert got[-1].content["alarms"][0]["begin_km"] == 3e4
    store.keep_alarms(VEHICLE, FIRST, [replace(ACT, end_km=2e4), replace(again, end_km=4e4)])
    clock.now += timedelta(hours=4)
    notifier.once()
    assert ("k_p", "cleared") in states(got[-1])
    clock.now += timedelta(days=1)
    notifier.once()
    assert states(got[-1]) == [("c_s", "known")]


@pytest.mark.usefixtures("_every_look")
def test_an_unreadable_alarm_is_logged_once_and_sent_when_it_is_corrected(told, caplog):
    store, notifier, _, got, _ = told
    notifier.once()
    store.keep_alarms(VEHICLE, SECOND, [replace(NOTICE, severity=Severity.ACT)])
    with closing(sqlite3.connect(str(store))) as other, other:
        other.execute("UPDATE alarms SET severity = 99")
    for _ in range(2):
        assert notifier.once() == (0, 0)
    assert caplog.text.count("alarms, row begin_km=10000.0, parameter=c_s, cause=change of") == 1
    with closing(sqlite3.connect(str(store))) as other, other:
        other.execute("UPDATE alarms SET severity = ?", (int(Severity.ACT),))
    assert notifier.once() == (1, 0)
    assert states(got[-1]) == [("c_s", "new")]
    assert {row.table for row in store.bad_rows} == {"alarms"}


def test_alarms_cleared_before_a_recipient_was_known_are_not_sent(told):
    store, notifier, clock, got, _ = told
    store.keep_alarms(VEHICLE, FIRST, [replace(ACT, end_km=2e4)])
    clock.now += timedelta(hours=4)
    notifier.once()
    assert [states(one) for one in got] == [[("c_s", "new")]]


def test_a_failed_message_is_tried_again_later_and_given_up_in_the_end(told, caplog, monkeypatch):
    most = 4
    for module in (outbox, notifier_module):
        monkeypatch.setattr(module, "MOST_ATTEMPTS", most)
    store, notifier, clock, got, _ = told
    got.n_failures = 2
    assert notifier.once() == (0, 1)
    assert notifier.once() == (0, 0)  # not due yet
    clock.now += timedelta(seconds=61)
    assert notifier.once() == (0, 1)
    clock.now += timedelta(seconds=61)
    assert notifier.once() == (0, 0)  # the wait has doubled
    clock.now += timedelta(seconds=61)
    assert notifier.once() == (1, 0)
    got.n_failures = 1000
    store.keep_alarms(VEHICLE, SECOND, [replace(NOTICE, severity=Severity.ACT)])
    for _ in range(most + 2):
        notifier.look()
        clock.now += timedelta(hours=6)
        notifier.once()
    lost = [row for row in store.outbox().unsent() if row["kind"] == "alarms"]
    assert [row["attempts"] for row in lost] == [most]
    assert "content" not in lost[0]
    attempts = [row["attempts"] for row in store.outbox().unsent()]
    n_given_up = sum(n >= outbox.MOST_ATTEMPTS for n in attempts)
    oldest = store.outbox().unsent()[0]
    counts = len(attempts) - n_given_up, n_given_up, oldest["created_s"]
    assert store.outbox().count_unsent() == counts
    assert "given up" in caplog.text
    got.n_failures = 0
    store.outbox().retry()
    notifier.once()
    assert store.outbox().unsent() == []
    assert len({one.id for one in got}) == len(got)


@pytest.mark.parametrize("told", KINDS, indirect=True)
def test_a_claimed_message_belongs_to_one_program_until_its_lease_is_over(told):
    store, notifier, clock, *_ = told
    notifier.look()
    assert store.outbox().claim(clock.now, ["of other rules"]) is None
    claimed = store.outbox().claim(clock.now, ["hook"])
    assert store.outbox().claim(clock.now, ["hook"]) is None
    assert notifier.once() == (0, 0)
    clock.now += timedelta(seconds=LEASE_S + 1)
    again = store.outbox().claim(clock.now, ["hook"])
    assert again == claimed


@pytest.mark.parametrize("told", KINDS, indirect=True)
def test_several_notifiers_at_the_same_time_send_each_message_once(told):
    store, _, clock, got, rules = told
    clock.now += timedelta(hours=4)
    others = [Notifier(store, rules, clock) for _ in range(4)]
    threads = [threading.Thread(target=one.once) for one in others]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    assert sorted(one.kind for one in got) == ["alarms", "digest"]
    assert store.outbox().unsent() == []


def webhook_rules(path, url):
    hook = {"kind": "webhook", "url": url}
    workshop = {"channels": ["hook"], "digest": None}
    return rules_file(path / "notify.json", {"hook": hook}, {"workshop": workshop})


def test_a_webhook_is_signed_and_its_secret_stays_secret(tmp_path, caplog, monkeypatch):
    webhooks = pytest.importorskip("standardwebhooks.webhooks")
    caplog.set_level(logging.DEBUG)
    with receiving(lambda n: 500 if n == 1 else 204) as (url, got):
        rules = read_rules(webhook_rules(tmp_path, url))
        with History(fill(tmp_path / "a.db")) as store:
            clock = Clock()
            notifier = Notifier(store, rules, clock)
            assert notifier.once() == (0, 1)
            assert "HTTP status 500" in store.outbox().unsent()[0]["error"]
            clock.now += timedelta(minutes=2)
            monkeypatch.delenv("SUSPNET_WEBHOOK_SECRET")
            assert notifier.once() == (0, 1)
            assert "SUSPNET_WEBHOOK_SECRET" in store.outbox().unsent()[0]["error"]
            monkeypatch.setenv("SUSPNET_WEBHOOK_SECRET", KEY)
            clock.now += timedelta(minutes=3)
            assert notifier.once() == (1, 0)
    first, second = [headers["webhook-id"] for headers, _ in got]
    assert first == second
    headers, body = got[1]
    assert webhooks.Webhook(KEY).verify(body, headers)["id"] == second
    with pytest.raises(webhooks.WebhookVerificationError):
        webhooks.Webhook(KEY).verify(body.replace(b"act", b"act "), headers)
    assert KEY not in caplog.text
    assert KEY not in (tmp_path / "a.db").read_bytes().decode(errors="replace")


@pytest.mark.skipif(not shutil.which("openssl"), reason="needs openssl to make a certificate")
def test_a_server_with_tls_is_checked_by_its_certificate(tmp_path, monkeypatch):
    key, certificate = tmp_path / "key", tmp_path / "certificate"
    command = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -subj /CN=x"
    made = ["-addext", "subjectAltName=DNS:localhost", "-keyout", key, "-out", certificate]
    subprocess.run([*command.split(), *made], check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    with receiving(context=context) as (url, got):
        hook = Webhook(url.replace("http://127.0.0.1", "https://localhost") + "?ü")
        with pytest.raises(DeliveryError, match="SSLCertVerificationError"):
            hook.send(MESSAGE)
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        hook.send(MESSAGE)
    assert len(got) == 1


@pytest.mark.parametrize(
    ("error", "n_sent"), [(AddressError("who?"), 3), (DeliveryError("the server is down"), 2)]
)
def test_a_failure_holds_up_no_other_channel_and_an_address_no_other(told, error, n_sent):
    store, _, clock, got, rules = told
    slow = Recorder()
    slow.n_failures, slow.error = 1, error
    people = [replace(rules.recipients[0], targets=(("slow", ""), ("hook", "")))]
    rules = replace(rules, recipients=people, channels={**rules.channels, "slow": slow})
    clock.now += timedelta(hours=4)  # the digest is due too
    assert Notifier(store, rules, clock).once() == (n_sent, 1)
    assert len(got) == 2


def test_a_running_notifier_goes_on_after_any_fault(told, monkeypatch, caplog):
    monkeypatch.setattr(notifier_module, "LOOK_S", 0.01)
    _, notifier, _, got, _ = told
    look, faults = notifier.look, [ZeroDivisionError("odd"), HistoryError("the store is away")]

    def failing():
        if faults:
            raise faults.pop()
        look()

    monkeypatch.setattr(notifier, "look", failing)
    notifier.start()
    assert until(lambda: got)
    notifier.close()
    assert "the store is away; notifications wait for it" in caplog.text
    assert "notifications failed" in caplog.text
    assert len(got) == 1


@pytest.mark.parametrize("moment", [pytest.param("before", marks=pytest.mark.slow), "after"])
def test_a_program_killed_while_it_posts_loses_nothing(tmp_path, moment):
    """Killed before the server accepts, the message comes later; after it, once more, same id."""
    processes = []

    def kill(n):
        if n == 1 and moment == "before":
            os.kill(processes[0].pid, signal.SIGKILL)
        return 204

    path = str(fill(tmp_path / "a.db"))
    with receiving(kill) as (url, got):
        rules = webhook_rules(tmp_path, url)
        context = multiprocessing.get_context("fork")
        process = context.Process(target=_notify_apart, args=(path, rules, moment == "after"))
        processes.append(process)
        process.start()
        process.join(30)
        assert process.exitcode == -signal.SIGKILL
        with History(path) as store:
            assert len(store.outbox().unsent()) == 1
            later = Clock()
            later.now = datetime.now(UTC) + timedelta(seconds=LEASE_S)
            assert Notifier(store, read_rules(rules), later).once() == (1, 0)
            assert store.outbox().unsent() == []
    assert len(got) == 2
    assert len({headers["webhook-id"] for headers, _ in got}) == 1
    assert got[0][1] == got[1][1]


def _notify_apart(path, rules, dies_before_mark):
    if dies_before_mark:
        outbox.Outbox.mark_sent = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
    notify_forever(path, rules, LEASE_S)


@contextmanager
def mail_server(accept):
    """Serve SMTP; `accept` returns the answer to the n-th mail. Yields its port and the mails."""
    controller = pytest.importorskip("aiosmtpd.controller")
    got = []

    class Sink:
        async def handle_DATA(self, server, session, envelope):  # noqa: N802 - aiosmtpd's name
            got.append((envelope.rcpt_tos, envelope.content))
            return accept(len(got))

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = controller.Controller(Sink(), hostname="127.0.0.1", port=port)
    server.start()
    try:
        yield port, got
    finally:
        server.stop()


def test_each_address_gets_its_mail_once_and_no_text_becomes_a_header(tmp_path):
    with mail_server(lambda n: "451 later" if n == 1 else "250 OK") as (port, got):
        mail = {"kind": "email", "host": "127.0.0.1", "port": port, "security": "none"}
        people = {"kim": {"channels": ["m"], "to": ["kim@example.org", "li@example.org"]}}
        file = rules_file(
            tmp_path / "n.json", {"m": mail | {"sender": "suspnet@example.org"}}, people
        )
        clock = Clock()
        with History(fill(tmp_path / "a.db")) as store:
            notifier = Notifier(store, replace(read_rules(file), zone=UTC), clock)
            assert notifier.once() == (0, 1)
            clock.now += timedelta(minutes=2)
            assert notifier.once() == (2, 0)
            clock.now += timedelta(minutes=2)
            assert notifier.once() == (0, 0)
    mails = [(to, message_from_bytes(body, policy=policy.default)) for to, body in got]
    assert sorted(to[0] for to, _ in mails[1:]) == ["kim@example.org", "li@example.org"]
    ids = [mail["Message-ID"] for _, mail in mails]
    assert len(set(ids)) == 2
    assert all(mail["Bcc"] is None for _, mail in mails)
    assert mails[1][1]["Subject"] == "suspnet: act: AM96 217: bogie 1, left: k_p"
    assert "act: AM96 217: bogie 1, left: k_p (limit), since 10 000 km" in mails[1][1].get_content()


HOOK = {"kind": "webhook", "url": "https://h/"}
MAIL = {"kind": "email", "host": "h", "sender": "a@b"}
ONLY = {"channels": ["h"]}
WRONG = [
    ({"h": {"kind": "mqtt", "host": "h"}}, {}, "must be one of email, webhook, got 'mqtt'"),
    ({"h": HOOK | {"url": "file:///etc/passwd"}}, {}, "must be https://HOST"),
    ({"h": HOOK | {"url": "https://u:p@h/"}}, {}, "without a user"),
    ({"h": HOOK | {"key": 1}}, {}, "has no key 'key'"),
    ({"h": HOOK | {"secret_env": "HOME"}}, {"a": ONLY}, "starts with SUSPNET_"),
    ({"h": HOOK | {"secret_env": "SUSPNET_NONE"}}, {"a": ONLY}, "export SUSPNET_NONE="),
    ({}, {"a": ONLY}, "'h' is not a channel; known: none"),
    ({}, {}, "`recipients` must name a recipient"),
    ({"h": HOOK}, {"a": ONLY | {"digest": None, "at_once": []}}, "neither `at_once` nor `digest`"),
    ({"h": HOOK}, {"a": ONLY | {"vehicles": []}}, "`recipients.a.vehicles` is empty"),
    ({"h": HOOK}, {"a": ONLY | {"vehicles": "x"}}, "must be a list of texts"),
    ({"h": HOOK}, {"a": ONLY | {"digest": "soon"}}, "must be a time such as 06:00"),
    ({"h": HOOK}, {"a": ONLY | {"severities": ["odd"]}}, "must be of notice, act"),
    ({"h": MAIL | {"user": "u", "security": "none"}}, {}, "unencrypted"),
    ({"h": MAIL}, {"a": ONLY | {"to": ["x\r\nBcc: y@z"]}}, "must list e-mail addresses"),
]


@pytest.mark.parametrize(("channels", "recipients", "words"), WRONG)
def test_a_wrong_rule_is_one_line_with_its_file_and_place(tmp_path, channels, recipients, words):
    file = rules_file(tmp_path / "n.json", channels, recipients)
    with pytest.raises(ValueError, match=words) as caught:
        read_rules(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)


def test_an_evaluation_sends_what_is_new_once(tmp_path, monkeypatch):
    from cli_runner import run_program  # here: killed programs import this module, and quickly

    from suspnet.cli import evaluate
    from suspnet.trains.history import database as module

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(evaluate, "write_maintenance", lambda *_: [])
    store, opened = fill(tmp_path / "a.db"), []
    connect = module.connect
    monkeypatch.setattr(module, "connect", lambda *_, **__: opened.append(1) or connect(*_, **__))
    with receiving() as (url, got):
        given = ["study=maintenance", f"notify={webhook_rules(tmp_path, url)}"]
        for _ in range(2):
            assert run_program(evaluate, tmp_path / "out", *given, f"store={store}") == 0
        assert len(opened) == 2  # once each time
        assert "`notify` needs store=FILE" in run_program(evaluate, tmp_path / "out", *given)
    ((_, body),) = got
    assert [one["parameter"] for one in json.loads(body)["alarms"]] == ["k_p"]
