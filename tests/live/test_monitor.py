import multiprocessing
import os
import signal
import threading
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import yaml
from monitor_frames import AtOnce, ListSource, all_frames, by_time, mileage_frame, trip_frames
from stream_signals import disturbed, interleaved
from trip_fixtures import OUTPUTS, model_at, recalled_trip, small_fleet

from suspnet.depot.live.journal import Journal, JournalError
from suspnet.depot.live.monitor import Monitor
from suspnet.depot.live.results import report
from suspnet.depot.live.sections import LiveSettings
from suspnet.depot.live.suspension import EstimateJob, LiveSuspension, read_suspensions
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.history import History, HistoryError
from suspnet.trains.jobs.fleet import FleetSettings
from suspnet.trains.recordings.assembler import OrderSettings
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.frames import Frame, decode, encode
from suspnet.trains.recordings.manifest_files import read_manifest

WINDOW = 6
LIVE = LiveSettings(section_s=300, late_s=20.0, order=OrderSettings(WINDOW))
SETTINGS = FleetSettings(TripSettings())


@pytest.fixture(scope="module")
def fleet():
    return small_fleet()


def suspensions(fleet, live=LIVE, **changes):
    """Return the one suspension of the small fleet."""
    manifest = replace(read_manifest(fleet[0]), **changes)
    return [LiveSuspension(manifest, [model_at()], SETTINGS.trips, live)]


def monitored(folder, fleet, source, live=LIVE, **options):
    """Run a monitor until its source ends; return what the store has then."""
    with History(folder / "fleet.db") as store, Journal(folder / "journal") as journal:
        store_result = partial(report, store, SETTINGS)
        monitor = Monitor(suspensions(fleet, live), source, journal, store_result, **options)
        monitor.resume()
        monitor.run()
    return kept(folder, fleet), monitor


def kept(folder, fleet):
    manifest = read_manifest(fleet[0])
    with History(folder / "fleet.db") as store:
        return store.read(manifest.vehicle, manifest.place)


def frames_of_trips(paths):
    """Return the encoded frames of some trips by their time."""
    return list(_frames_of_trips(tuple(paths)))


@cache
def _frames_of_trips(paths):
    every = []
    for path in paths:
        every.append(mileage_frame(path))
        every += [one for several in trip_frames(path).values() for one in several]
    for name in {one.sensor for one in every}:
        own = sorted((one for one in every if one.sensor == name), key=lambda one: one.time_ns)
        at = {id(one): k for k, one in enumerate(own)}
        every = [replace(o, sequence=at[id(o)]) if id(o) in at else o for o in every]
    return by_time(every)


def assert_same_estimate(one, other):
    assert (one.status, one.flags, one.mileage_km) == (other.status, other.flags, other.mileage_km)
    for name in OUTPUTS:
        np.testing.assert_allclose(one.estimates[name], other.estimates[name], rtol=1e-10)
        np.testing.assert_allclose(one.half_widths[name], other.half_widths[name], rtol=1e-9)


# reference


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_history_of_a_stream_is_that_of_the_files(tmp_path, fleet, seed):
    """The frames of a trip come cut at random, twice, and out of order."""
    rng = np.random.default_rng(seed)
    path = fleet[seed % len(fleet)]
    parts = [disturbed(one, rng, WINDOW) for one in trip_frames(path, rng).values()]
    frames = [mileage_frame(path), *interleaved(parts, rng)]
    lump, pauses = int(rng.integers(1, 200)), bool(seed % 2)
    source = ListSource([encode(one) for one in frames], lump, pauses=pauses)
    (found,), monitor = monitored(tmp_path, fleet, source)
    expected = recalled_trip(path, [model_at()], SETTINGS.trips)
    assert_same_estimate(found, expected)
    assert found.start == expected.start
    assert monitor.counts == {"taken": len(frames)}
    assert source.confirmed == len(frames)


def test_the_mileage_goes_on_with_the_speed(tmp_path, fleet):
    live = replace(LIVE, section_s=100)
    source = ListSource(all_frames(fleet[1]))
    found, _ = monitored(tmp_path, fleet, source, live)
    start_km = read_manifest(fleet[0]).mileage_km  # the suspension's manifest, no frame tells it
    np.testing.assert_allclose(found[0].mileage_km, start_km)
    steps = np.diff([one.mileage_km for one in found])
    np.testing.assert_allclose(steps, 7.0, rtol=0.03)  # 100 s at 70 m/s, but for the ends


def two_sections(fleet, several):
    """Return frames of a section of several suspensions, then some of the next one."""
    every = [decode(one) for one in frames_of_trips(fleet[:1]) + frames_of_trips(fleet[1:2])[:300]]
    return [encode(replace(one, suspension=to.name)) for one in every for to in several]


def test_frames_are_taken_while_an_estimate_is_made(tmp_path, fleet, monkeypatch):
    several = [suspensions(fleet, train=str(k))[0] for k in range(2)]
    frames = two_sections(fleet, several)
    source = ListSource(frames, at_once=len(frames) - 40, pauses=True)
    told, receive, all_given, make = [], source.receive, threading.Event(), EstimateJob.make

    def received(timeout_s):
        source.at_once = 4 if source.at else source.at_once
        given = receive(timeout_s)
        if given is None:
            all_given.set()
        return given

    def make_late(job):
        assert all_given.wait(60)
        return make(job)

    source.receive = received
    monkeypatch.setattr(EstimateJob, "make", make_late)
    with Journal(tmp_path / "journal") as journal:
        Monitor(several, source, journal, lambda one, what: told.append((one.name, what))).run()
    assert [name for name, _ in told[:2]] == [one.name for one in several]
    # both are due at once, the first estimate lasts as long as frames come, and none is lost
    assert {what.result.status for _, what in told[:2]} == {"ok"}
    assert source.confirmed == len(frames)


# kills


def run_child(folder, fleet, frames, last=None):
    """Run a monitor to the end, or until it asks for frames after `last` of them."""
    source = ListSource(frames, offset=folder / "offset", pauses=True)
    if last is not None:
        receive = source.receive

        def received(timeout_s):
            if source.at >= last:
                os.kill(os.getpid(), signal.SIGKILL)
            return receive(timeout_s)

        source.receive = received
    monitored(folder, fleet, source)


def test_killed_monitors_lose_and_double_nothing(tmp_path, fleet):
    """A monitor is killed without warning, and started again, until it has read all."""
    n_trips, n_kills, rng = 1, 2, np.random.default_rng(0)
    frames = frames_of_trips(fleet[:n_trips])
    (tmp_path / "whole").mkdir()
    expected, _ = monitored(tmp_path / "whole", fleet, ListSource(frames))
    fork, killed = multiprocessing.get_context("fork"), 0
    for i in range(n_kills + 2):  # by itself as it asks for frames, at any moment, and not at all
        last = int(rng.integers(len(frames))) if i < n_kills else None
        child = fork.Process(target=run_child, args=(tmp_path, fleet, frames, last))
        child.start()
        child.join(rng.uniform(0, 1.0) if i == n_kills else 120)
        if child.is_alive():
            os.kill(child.pid, signal.SIGKILL)
        child.join()
        killed += child.exitcode == -signal.SIGKILL
    assert child.exitcode == 0
    found = kept(tmp_path, fleet)
    assert len(found) == len(expected) == n_trips
    for one, other in zip(found, expected, strict=True):
        assert_same_estimate(one, other)
        assert (one.trip, one.start, one.quality) == (other.trip, other.start, other.quality)
    assert killed >= 1


# failure


def test_bad_frames_are_counted_logged_once_and_change_nothing(tmp_path, fleet, caplog):
    rng = np.random.default_rng(0)
    frames = all_frames(fleet[0])
    good = Frame(str(read_manifest(fleet[0]).place), "body", 1, 10**18, 250.0, "m/s2", np.ones(9))
    nan = bytearray(encode(replace(good, samples=np.full(9, 7.0))))
    at = nan.index(np.full(9, 7.0).tobytes())
    nan[at : at + 8] = np.array([np.nan]).tobytes()
    bad = {
        "foreign": b"noise",
        "truncated": frames[0][:-100],
        "size": b"\0" * 10**6,
        "suspension": encode(replace(good, suspension="another train")),
        "sensor": encode(replace(good, sensor="cabin")),
        "rate": encode(replace(good, rate_hz=200.0)),
        "unit": encode(replace(good, unit="furlong")),
        "nan": bytes(nan),
        "range": encode(replace(good, sensor="mileage", unit="km", samples=np.array([-1.0]))),
    }
    mixed = []
    for data in frames:
        mixed.append(data)
        if rng.random() < 0.2:
            mixed.append(list(bad.values())[rng.integers(len(bad))])
    (found,), monitor = monitored(tmp_path, fleet, ListSource(mixed + list(bad.values())))
    assert set(monitor.counts) == {"taken", *bad}
    words = [one.getMessage() for one in caplog.records if "cannot be used" in one.getMessage()]
    assert len(words) == len(bad)
    with Journal(tmp_path / "journal") as journal:  # the state alone
        assert sum(journal.n_bytes.values()) == 0
    manifest = read_manifest(fleet[0])
    expected = recalled_trip(fleet[0], [model_at()], SETTINGS.trips)
    assert_same_estimate(found, replace(expected, mileage_km=manifest.mileage_km))


def test_a_store_that_is_away_is_waited_for(tmp_path, fleet, monkeypatch):
    failed, write = [], History.write

    def away(self, results):
        if len(failed) < 2:
            failed.append(1)
            raise HistoryError("fleet.db: the store cannot be used")
        write(self, results)

    monkeypatch.setattr(History, "write", away)
    monkeypatch.setattr("suspnet.depot.live.results.WAIT_S", 0.0)
    found, _ = monitored(tmp_path, fleet, ListSource(frames_of_trips(fleet[:1])))
    assert len(found) == 1
    assert len(failed) == 2


def test_nothing_is_confirmed_that_is_not_in_the_journal(tmp_path, fleet, monkeypatch):
    source = ListSource(frames_of_trips(fleet[:1]))

    def full(self):
        raise JournalError("journal: the journal cannot be written (disk is full)")

    monkeypatch.setattr(Journal, "write", full)
    with pytest.raises(JournalError, match="disk is full"):
        monitored(tmp_path, fleet, source)
    assert source.confirmed == 0


def test_a_suspension_that_falls_silent_is_told_and_goes_on_as_another_trip(tmp_path, fleet):
    frames, now_s = frames_of_trips(fleet[:1]), [0.0]
    source = ListSource([])
    rounds = [frames[:121], [], [], frames[121:], [], []]
    source.receive = lambda timeout_s: rounds.pop(0) if rounds else None

    def clock():
        now_s[0] += 1000.0
        return now_s[0]

    with History(tmp_path / "fleet.db") as store, Journal(tmp_path / "journal") as journal:
        store_result, (one,) = partial(report, store, SETTINGS), suspensions(fleet)
        monitor = Monitor([one], source, journal, store_result, 1500.0, clock, AtOnce())
        monitor.run()
    first, second = kept(tmp_path, fleet)
    expected = recalled_trip(fleet[0], [model_at()], SETTINGS.trips)
    lost_s = expected.quality.duration_s - first.quality.duration_s - second.quality.duration_s
    assert (first.status, second.status, second.reason) == ("ok", "ok", "")
    assert 0 <= lost_s < 10
    km = expected.mileage_km + 0.07 * first.quality.duration_s
    assert second.mileage_km == pytest.approx(km, abs=0.3)


def test_journal_of_other_settings_is_refused(tmp_path, fleet):
    frames = frames_of_trips(fleet[:1])[:40]  # too few to estimate from
    monitored(tmp_path, fleet, ListSource(frames))
    with pytest.raises(
        JournalError, match="restore the previous settings, or give another journal="
    ):
        monitored(tmp_path, fleet, ListSource(frames), replace(LIVE, section_s=200))


def test_manifests_of_a_folder_need_no_files(tmp_path, fleet):
    (tmp_path / "live.yaml").write_text(fleet[0].read_text())
    (found,) = read_suspensions(tmp_path, [model_at()], SETTINGS, LIVE)
    assert found.name == str(read_manifest(fleet[0]).place)


@pytest.mark.parametrize("name", ["a\x1b[2J", "a" * 100])
def test_manifest_of_a_name_that_no_frame_can_have_is_refused(tmp_path, fleet, name):
    content = yaml.safe_load(fleet[0].read_text())
    content |= {"suspension": name, "train": "1" * 100, "car": "2" * 100}
    (tmp_path / "live.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(TripError, match="frames cannot name the suspension") as error:
        read_suspensions(tmp_path, [model_at()], SETTINGS, LIVE)
    assert str(error.value).isprintable()


def test_two_manifests_of_one_suspension_are_refused(fleet, tmp_path):
    with (
        Journal(tmp_path / "journal") as journal,
        pytest.raises(ValueError, match="same suspension"),
    ):
        Monitor(suspensions(fleet) * 2, ListSource([]), journal, print)
