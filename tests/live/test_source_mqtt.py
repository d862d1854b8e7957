"""Frames from a real broker, which is stopped, killed and restarted while they flow."""

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import contextmanager

import pytest
from live_frames import Mosquitto, Sender, encoded, frame, numbers, received, until

from suspnet.depot.live.broker import Broker
from suspnet.depot.live.mqtt import TAKEN_OVER, Mqtt, is_in_shard
from suspnet.trains.recordings.frames import MOST_SAMPLES, encode

paho = pytest.importorskip("paho.mqtt.client")
NAMES = [f"train {k // 4}, car {k % 4}, leading bogie" for k in range(12)]
ONE = "train 1, car 2"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch):
    """Connect again soon."""
    monkeypatch.setattr("suspnet.depot.live.broker.BACKOFF_S", (0.05, 0.2))


@contextmanager
def running(broker):
    try:
        yield broker.start()
    finally:
        broker.end(signal.SIGKILL)


@pytest.fixture
def broker(tmp_path):
    with running(Mosquitto(tmp_path)) as started:
        yield started


@pytest.fixture
def clients(monkeypatch):
    """List the clients of paho-mqtt that are made, those of sources first."""
    made, make = [], Broker.client
    monkeypatch.setattr(
        Broker, "client", lambda *args, **more: made.append(make(*args, **more)) or made[-1]
    )
    return made


@pytest.fixture
def opened():
    """Return a function that opens sources; they and senders are closed at the end."""
    made = []

    def open_(part, names=(ONE,)):
        made.append(part)
        if isinstance(part, Mqtt):  # the session has to be known to the broker
            part.subscribe(list(names))
            until(lambda: part.is_connected, 2.0)
            time.sleep(0.05)
        return part

    yield open_
    for one in made:
        one.close()


def at(broker, **options):
    return Broker(port=broker.port, **options)


def send(sink, n, start=0, **options):
    for k in range(start, start + n):
        sink.send(frame(k, **options))


def raw_client(broker):
    client = paho.Client(paho.CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    client.connect("127.0.0.1", broker.port)
    client.loop_start()
    return client


def test_confirmed_frames_never_come_again(broker, opened):
    first, sink = opened(Mqtt(at(broker))), opened(Sender(at(broker)))
    send(sink, 300)
    send(sink, 2, suspension="another")
    assert numbers(received(first, 300)) == numbers(encoded(300))
    first.confirm()
    send(sink, 5, 300)
    assert len(received(first, 5)) == 5
    first.close()  # without a confirmation
    send(sink, 5, 305)
    second = opened(Mqtt(at(broker)))
    assert [number for *_, number in numbers(received(second, 10))] == list(range(300, 310))
    assert second.receive(0.1) == []
    assert second.counts == {}


def test_broker_restarted_while_frames_flow_loses_none(broker, opened):
    source, sink = opened(Mqtt(at(broker))), opened(Sender(at(broker)))
    thread = threading.Thread(target=send, args=(sink, 300))
    thread.start()
    found = received(source, 30)
    source.confirm()
    broker.end()
    assert until(lambda: not source.is_connected)
    source.confirm()
    time.sleep(0.2)
    broker.start()
    seen = set(numbers(found))
    last = time.monotonic() + 8
    while len(seen) < 300 and time.monotonic() < last:
        seen |= set(numbers(source.receive(0.1)))
        source.confirm()
    thread.join()
    assert [number for *_, number in sorted(seen)] == list(range(300))
    assert source.counts["reconnect"] == 1


def test_broker_that_is_not_there_yet_is_waited_for(tmp_path, opened, caplog):
    broker = Mosquitto(tmp_path)
    source = Mqtt(at(broker))
    source.subscribe([ONE])
    begin = time.monotonic()
    assert source.receive(0.1) == []
    assert time.monotonic() - begin < 2
    source.confirm()
    assert until(lambda: source.counts["unreachable"])
    assert [one.getMessage() for one in caplog.records if "connection refused" in one.getMessage()]
    with running(broker):
        assert until(lambda: source.is_connected)
        sink = opened(Sender(at(broker)))
        send(sink, 3)
        assert len(received(source, 3)) == 3
        source.close()
        sink.close()


def test_parts_share_the_suspensions(broker, opened):
    sources = [opened(Mqtt(at(broker), part=f"{k}/3"), NAMES) for k in (1, 2, 3)]
    sink = opened(Sender(at(broker)))
    for name in NAMES:
        send(sink, 4, suspension=name)
    sink.close()
    until(lambda: sum(len(one._arrived) for one in sources) == 48)
    found = [numbers(received(one, 1)) for one in sources]
    assert all(found)
    taken = Counter(name for part in found for name in {name for name, *_ in part})
    assert taken == dict.fromkeys(NAMES, 1)
    assert sum(map(len, found)) == 48
    # parts are of like size
    shares = [sum(is_in_shard(f"train {k}", n, 7) for k in range(1000)) for n in range(1, 8)]
    assert sum(shares) == 1000
    assert min(shares) > 0.8 * 1000 / 7


def test_monitor_whose_session_another_one_has_taken_ends(broker, opened, clients):
    source = opened(Mqtt(at(broker)))
    client = clients[0]
    client.on_disconnect(client, None, None, TAKEN_OVER, None)  # as newer brokers do
    with pytest.raises(ValueError, match="another monitor has connected as 'suspnet-monitor-1-of-"):
        source.receive(0.1)
    time.sleep(0.3)
    assert not source.is_connected


def test_monitor_that_is_busy_is_disconnected_and_misses_nothing(broker, opened, clients):
    source, sink = opened(Mqtt(at(broker), in_flight=10)), opened(Sender(at(broker)))
    send(sink, 40)
    sink.close()
    for k in range(1, 4):
        assert until(lambda: len(source._arrived) == 10)
        clients[0].socket().shutdown(socket.SHUT_RDWR)  # as a broker does that hears nothing
        assert len(source.receive(1.0)) <= 10
        assert until(lambda k=k: source.counts["reconnect"] == k)
    seen = set()
    while len(seen) < 40:  # ends: a test has a time limit
        seen |= set(numbers(source.receive(1.0)))
        source.confirm()
    assert source.receive(0.1) == []


def test_message_that_is_no_frame_is_given_like_any_other(broker, opened):
    source, sink = opened(Mqtt(at(broker))), opened(Sender(at(broker)))
    client, topic = raw_client(broker), at(broker).topic(ONE)
    largest = encode(frame(n=MOST_SAMPLES))
    messages = [b"", b"foreign", os.urandom(1000), largest]
    for payload in messages:
        client.publish(topic, payload, qos=1).wait_for_publish(5)
    send(sink, 1, 1)
    client.publish(topic, encode(frame(2)), qos=0)  # without acknowledgement
    assert sorted(received(source, 6)) == sorted([*messages, encode(frame(1)), encode(frame(2))])
    source.confirm()
    client.disconnect()
    client.loop_stop()


def test_messages_that_the_broker_lets_through_are_counted(tmp_path, opened):
    with running(Mosquitto(tmp_path, "max_packet_size 20000000")) as broker:
        source, sink = opened(Mqtt(at(broker), in_flight=5)), opened(Sender(at(broker)))
        client, topic = raw_client(broker), at(broker).topic(ONE)
        for _ in range(20):
            client.publish(topic, bytes(1_000_000), qos=1).wait_for_publish(5)
        send(sink, 3)
        assert numbers(received(source, 3)) == numbers(encoded(3))
        assert source.counts == {"size": 20}
        client.disconnect()
        client.loop_stop()
        source.close()
        sink.close()


def test_password_is_read_from_the_environment(tmp_path, opened, monkeypatch):
    program = shutil.which("mosquitto_passwd")
    if program is None:
        pytest.skip("needs mosquitto_passwd: apt-get install mosquitto")
    passwords = tmp_path / "passwords"
    subprocess.run([program, "-b", "-c", passwords, "monitor", "right"], check=True)
    passwords.chmod(0o644)
    broker = Mosquitto(tmp_path, f"password_file {passwords}")
    file = tmp_path / "mosquitto.conf"
    file.write_text(file.read_text().replace("\nallow_anonymous true", "\nallow_anonymous false"))
    with running(broker):
        with pytest.raises(ValueError, match="export SUSPNET_MQTT_PASSWORD="):
            Mqtt(at(broker, user="monitor")).subscribe([])
        monkeypatch.setenv("SUSPNET_MQTT_PASSWORD", "wrong")
        with pytest.raises(ValueError, match="Not authorized"):
            Sender(at(broker, user="monitor"))
        refused = Mqtt(at(broker, user="monitor"), "other")
        refused.subscribe([ONE])
        assert until(lambda: refused.counts["rejected"])
        refused.close()
        monkeypatch.delenv("SUSPNET_MQTT_PASSWORD")
        (tmp_path / "password").write_text("right\n")
        monkeypatch.setenv("SUSPNET_MQTT_PASSWORD_FILE", str(tmp_path / "password"))
        source = opened(Mqtt(at(broker, user="monitor")))
        sink = opened(Sender(at(broker, user="monitor")))
        send(sink, 2)
        assert len(received(source, 2)) == 2
        source.close()
        sink.close()


# paho-mqtt leaves the socket of a handshake that failed to the garbage collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")
def test_connection_with_tls(tmp_path, opened):
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl: apt-get install openssl")
    subprocess.run(
        [
            *("openssl", "req", "-x509", "-newkey", "ec", "-nodes", "-days", "2"),
            *("-pkeyopt", "ec_paramgen_curve:prime256v1"),
            *("-keyout", tmp_path / "key.pem", "-out", tmp_path / "cert.pem"),
            *("-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"),
        ],
        check=True,
        capture_output=True,
    )
    (tmp_path / "key.pem").chmod(0o644)
    certificate = str(tmp_path / "cert.pem")
    # of the listener that the configuration ends with
    broker = Mosquitto(tmp_path, f"certfile {certificate}", f"keyfile {tmp_path / 'key.pem'}")
    with running(broker):
        settings = at(broker, tls=True, ca_file=certificate)
        source, sink = opened(Mqtt(settings)), opened(Sender(settings))
        send(sink, 2)
        assert len(received(source, 2)) == 2
        distrusting = Mqtt(at(broker, tls=True), "other")
        distrusting.subscribe([ONE])
        assert until(lambda: distrusting.counts["unreachable"])
        distrusting.close()
        source.close()
        sink.close()


WRONG = {
    "prefix": ("a/#", "", "a\n", "a" * 201, 7),
    "host": ("", "a b"),
    "password_env": ("AWS_SECRET_ACCESS_KEY", "SUSPNET_A\n", 7),
}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        *(
            (lambda part=part: Mqtt(part=part), '`part` must be "K/N"')
            for part in ("0/2", "3/2", 2)
        ),
        (lambda: Mqtt(in_flight=0), "`in_flight` must be"),
        (lambda: Mqtt(session_h=0), "`session_h` must be"),
        (lambda: Broker(port=0), "`port` must be"),
        *(
            (lambda key=key, value=value: Broker(**{key: value}), f"`{key}` must be")
            for key, values in WRONG.items()
            for value in values
        ),
        (lambda: Broker(tls=True, key_file="/dev/zero").client(""), "there is no such file"),
        (lambda: Broker(ca_file="x"), "are for tls=true"),
    ],
)
def test_settings_out_of_range_are_refused(make, message):
    with pytest.raises((TypeError, ValueError, OSError), match=message):
        make()


def test_host_is_that_of_the_environment_unless_it_is_given(monkeypatch):
    assert Broker().where == "localhost:1883"
    monkeypatch.setenv("SUSPNET_MQTT_HOST", "depot.lan")
    assert Broker().where == "depot.lan:1883"
    assert Broker(host="other.lan", port=7).where == "other.lan:7"


def test_missing_paho_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    with pytest.raises(ValueError, match=r'pip install -e ".\[live\]"'):
        Mqtt().subscribe([])
