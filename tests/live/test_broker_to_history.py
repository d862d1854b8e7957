"""A replay over a broker that is restarted meanwhile gives the history that the files give."""

import threading
import time
from collections import Counter

import numpy as np
import pytest
from live_frames import Mosquitto
from trip_fixtures import OUTPUTS, model_at, recalled_trip, small_fleet

from suspnet.estimation.trip_settings import TripSettings
from suspnet.history import History
from suspnet.live.broker import Broker
from suspnet.live.journal import Journal
from suspnet.live.monitor import Monitor
from suspnet.live.mqtt import Mqtt
from suspnet.live.replay import trip_clock, trip_frames
from suspnet.live.results import Results
from suspnet.live.sections import LiveSettings
from suspnet.live.sinks import MqttSink
from suspnet.live.suspension import LiveSuspension
from suspnet.recordings.manifest_files import read_manifest
from suspnet.trips.fleet import FleetSettings

pytest.importorskip("paho.mqtt.client")
SETTINGS = FleetSettings(TripSettings())
LIVE = LiveSettings(section_s=300, every_s=None, late_s=20.0)


class Ending(Mqtt):
    """A source that ends once all was sent and nothing more comes."""

    is_sent = False

    def receive(self, timeout_s):
        frames = super().receive(timeout_s)
        return None if self.is_sent and not frames else frames


@pytest.mark.slow  # test_source_mqtt.py restarts it by default, test_monitor.py compares
def test_history_of_a_replay_over_a_restarted_broker_is_that_of_the_files(tmp_path):
    path = small_fleet()[0]
    manifest = read_manifest(path)
    frames = list(trip_frames(manifest, *trip_clock(manifest), Counter()))
    broker = Mosquitto(tmp_path).start()
    settings = Broker(port=broker.port)
    source, sink = Ending(settings, in_flight=300), MqttSink(settings)

    def send():
        while not source._is_connected:
            time.sleep(0.02)
        time.sleep(0.2)
        sink.open()
        for k, one in enumerate(frames):
            if k == len(frames) // 2:
                broker.end()
                broker.start()
            sink.send(one)
        sink.close()
        source.is_sent = True

    thread = threading.Thread(target=send)
    try:
        with History(tmp_path / "fleet.db") as store, Journal(tmp_path / "journal") as journal:
            suspension = LiveSuspension(manifest, [model_at()], SETTINGS.trips, LIVE)
            results = Results(store, SETTINGS, source.publish)
            monitor = Monitor([suspension], source, journal, results.report)
            thread.start()
            monitor.run()
            results.close()
            (found,) = store.read(manifest.vehicle, manifest.place)
    finally:
        thread.join()
        source.close()
        broker.end()
    expected = recalled_trip(path, [model_at()], SETTINGS.trips)
    for name in ("status", "flags", "mileage_km"):
        assert getattr(found, name) == getattr(expected, name)
    for name in OUTPUTS:
        np.testing.assert_allclose(found.estimates[name], expected.estimates[name], rtol=1e-10)
    assert monitor.counts["taken"] >= len(frames)
    assert set(monitor.counts) == {"taken"}
    assert source.counts["reconnect"] == 1
