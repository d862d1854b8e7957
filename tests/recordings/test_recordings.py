"""Whole trips from files: one clock, known signals back, faults marked, mistakes named."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest import CHANNELS
from suspnet.recordings.manifest_files import read_manifest
from suspnet.recordings.recording import Recording, load_recording
from suspnet.spectra.segments import recording_segments, sensor_segments
from suspnet.spectra.welch import Welch
from suspnet.trips.check import CheckSettings, check_trip

FREQUENCIES_HZ = np.array([0.5, 1.3, 4.0, 7.7, 12.0, 20.0, 25.0])
PHASES = np.arange(7) ** 2.0
RATES = {"axle_box": 2000.0, "bogie": 2000.0, "body": 1999.7}
DURATION_S = 64.0


def motion(times_s: np.ndarray) -> np.ndarray:
    """Return a sum of sinusoids in the pass band, [m/s2]."""
    return np.cos(2 * np.pi * times_s[:, None] * FREQUENCIES_HZ + PHASES).sum(axis=1)


@cache
def motion_at(rate_hz: float, duration_s: float, start_s: float) -> np.ndarray:
    return motion(np.arange(int(duration_s * rate_hz)) / rate_hz + start_s)


@pytest.fixture
def trip(tmp_path: Path) -> Callable[..., Path]:
    """Write a trip of one motion seen by all channels, with changes."""

    def write(
        signals: dict | None = None,
        times: dict | None = None,
        speed: object = 30.0,
        duration_s: float = DURATION_S,
        **changes: dict,
    ) -> Path:
        channels = {}
        for name in CHANNELS:
            channel = {"file": f"{name}.parquet", "column": "a", "unit": "m/s2"}
            channel |= {"rate_hz": RATES[name]} | changes.get(name, {})
            rate_hz = channel["rate_hz"] or RATES[name]
            at = np.arange(int(duration_s * rate_hz)) / rate_hz
            values = motion_at(rate_hz, duration_s, channel.get("start_s", 0.0))
            columns = {"t": (times or {}).get(name, at), "a": (signals or {}).get(name, values)}
            columns["t"] = columns["t"][: len(columns["a"])]
            options = {"row_group_size": 2**16, "use_dictionary": False}  # many times faster
            pq.write_table(pa.table(columns), tmp_path / channel["file"], **options)
            channels[name] = {key: value for key, value in channel.items() if value is not None}
        content = {"format": "suspnet-trip-1", "vehicle": "am96", "suspension": "car 7"}
        content |= {"mileage_km": 1.0, "speed": speed, "channels": channels}
        path = tmp_path / "trip.yaml"
        path.write_text(yaml.safe_dump(content))
        return path

    return write


def load(path: Path, **settings) -> Recording:
    recording = load_recording(read_manifest(path), **settings)
    n = len(recording.usable)
    assert recording.signals.shape == (3, n)
    assert recording.speed_m_per_s.shape == (n,)
    assert recording.duration_s == n / recording.rate_hz
    assert np.isfinite(recording.signals).all()
    assert np.isfinite(recording.speed_m_per_s[recording.usable]).all()
    return recording


def clock(recording: Recording) -> np.ndarray:
    return recording.start_s + np.arange(len(recording.usable)) / recording.rate_hz


def samples(name: str, duration_s: float = DURATION_S) -> np.ndarray:
    return np.arange(int(duration_s * RATES[name])) / RATES[name]


def write_speed(folder: Path, seconds, speed) -> None:
    pq.write_table(pa.table({"t": seconds, "v": speed}), folder / "speed.parquet")


def speed_from(tmp_path: Path, trip, seconds, speed, **source) -> Recording:
    write_speed(tmp_path, seconds, speed)
    source = {"file": "speed.parquet", "column": "v", "unit": "m/s", "time": "t"} | source
    source = {key: value for key, value in source.items() if value is not None}
    return load(trip(speed=source))


# --- reference: known motion comes back ------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [100.0, pytest.param(128.0, marks=pytest.mark.slow)])
def test_all_channels_give_the_same_motion_on_one_clock(trip, rate_hz):
    recording = load(trip(body={"rate_hz": None, "time": "t"}), rate_hz=rate_hz)
    assert DURATION_S - 0.3 < recording.duration_s < DURATION_S
    assert recording.usable.all()
    assert recording.faults == ()
    assert (recording.speed_m_per_s == 30.0).all()
    np.testing.assert_allclose(
        recording.signals, np.broadcast_to(motion(clock(recording)), recording.signals.shape),
        atol=2e-4,
    )  # fmt: skip


@pytest.mark.parametrize("rate_hz", [100.0, pytest.param(2048.0, marks=pytest.mark.slow), 5120.0])
def test_other_rates_and_a_bogie_that_has_only_times(trip, rate_hz):
    recording = load(trip(axle_box={"rate_hz": rate_hz}, bogie={"time": "t", "rate_hz": None}))
    np.testing.assert_allclose(recording.signals[0], recording.signals[1], atol=2e-4)


def test_starts_put_channels_on_one_clock(trip):
    recording = load(
        trip(
            axle_box={"start_s": 0.33371},
            bogie={"start_s": 1.25},
            body={"start_s": -0.5, "time": "t"},
            duration_s=65.0,
        )
    )
    assert 1.25 < recording.start_s < 1.4
    assert clock(recording)[-1] < 64.5
    for signal in recording.signals:
        np.testing.assert_allclose(signal, motion(clock(recording)), atol=2e-4)


def test_time_columns_start_where_they_say(trip):
    late = samples("body") + 2.0
    path = trip(signals={"body": motion(late)}, times={"body": late}, body={"time": "t"},
                duration_s=66.0)  # fmt: skip
    recording = load(path)
    assert recording.start_s > 2.0
    np.testing.assert_allclose(recording.signals[2], motion(clock(recording)), atol=2e-4)


def test_unit_and_sign_are_applied(trip):
    recording = load(trip(bogie={"unit": "g", "sign": -1}))
    np.testing.assert_allclose(recording.signals[1], -9.80665 * recording.signals[0], atol=2e-3)


def test_range_is_in_the_unit_of_the_channel(trip):
    values = np.clip(motion(samples("bogie")), -4, 4)
    assert load(trip(signals={"bogie": values}, bogie={"unit": "g", "range": 4.5})).usable.all()
    recording = load(trip(signals={"bogie": values}, bogie={"unit": "g", "range": 4.0}))
    assert {fault.kind for fault in recording.faults} == {"saturation"}
    assert 0.1 < recording.usable.mean() < 0.9


# --- faults ----------------------------------------------------------------------------------


def test_lost_samples_keep_the_clock_and_are_marked(trip):
    """A logger that drops two seconds, then one sample; only its time stamps tell."""
    times = samples("body")
    kept = np.ones(len(times), dtype=bool)
    kept[40_000:44_000] = kept[90_000] = False
    path = trip(
        signals={"body": motion(times[kept])}, times={"body": times[kept]}, body={"time": "t"}
    )
    recording = load(path)
    at = clock(recording)
    lost = (at > times[40_000] - 0.1) & (at < times[44_000] + 0.1)
    assert recording.usable[~lost].all()
    assert not recording.usable[(at > times[40_000]) & (at < times[44_000])].any()
    np.testing.assert_allclose(
        recording.signals[2, recording.usable], motion(at[recording.usable]), atol=2e-4
    )
    assert [(f.kind, f.n_samples, f.repaired) for f in recording.faults] == [
        ("gap", 1, True),
        ("gap", 4000, False),
    ]
    assert recording.faults[1].first_s == pytest.approx(times[40_000])


def test_faults_of_each_channel_are_listed_and_repaired(trip):
    values = {name: motion(samples(name)) for name in CHANNELS}
    values["axle_box"][40_000] = 5e3
    values["bogie"][50_000:50_002] = np.nan
    values["body"][70_000:72_000] = values["body"][70_000]
    values["body"] += 9.80665
    recording = load(trip(signals=values))
    assert [(f.channel, f.kind, f.repaired) for f in recording.faults] == [
        ("axle_box", "spike", True),
        ("bogie", "gap", True),
        ("body", "constant", False),
        ("body", "offset", True),
    ]
    at = clock(recording)
    held = (at > 34.9) & (at < 36.2)
    assert recording.usable[~held].all()
    assert not recording.usable[(at > 35.01) & (at < 36.0)].any()
    np.testing.assert_allclose(recording.signals[0], motion(at), atol=3e-4)
    np.testing.assert_allclose(recording.signals[1], motion(at), atol=3e-4)


# --- speed -----------------------------------------------------------------------------------


def test_speed_is_interpolated_in_its_unit(tmp_path, trip):
    seconds = np.arange(70.0)
    recording = speed_from(tmp_path, trip, seconds, 36 + 3.6 * seconds, unit="km/h")
    np.testing.assert_allclose(recording.speed_m_per_s, 10 + clock(recording))
    recording = speed_from(
        tmp_path, trip, seconds, seconds, time=None, rate_hz=2.0, start_s=35.0
    )  # fmt: skip
    at = clock(recording)
    known = recording.usable
    np.testing.assert_allclose(recording.speed_m_per_s[known], np.maximum(2 * (at[known] - 35), 0))
    np.testing.assert_array_equal(known, at >= 34.5 - 1e-9)


def test_speed_is_unknown_beside_wrong_values_and_in_long_gaps(tmp_path, trip):
    seconds = np.concatenate([np.arange(30.0), np.arange(45.0, 64.0)])
    speed = np.full(len(seconds), 20.0)
    speed[[5, 10, 15]] = [np.nan, -1.0, 1e4]
    recording = speed_from(tmp_path, trip, seconds, speed)
    at = clock(recording)
    known = np.isfinite(recording.speed_m_per_s)
    for start, stop in ((4, 6), (9, 11), (14, 16), (29, 45)):
        assert not known[(at > start + 1e-6) & (at < stop - 1e-6)].any()
        assert known[(at > stop + 0.01) & (at < stop + 2.9)].all()
    assert known[at < 4 - 1e-6].all()
    np.testing.assert_array_equal(recording.usable, known)


def test_one_speed_is_not_enough_for_a_trip(tmp_path, trip):
    with pytest.raises(TripError, match="`speed` needs `rate_hz` or `time`"):
        speed_from(tmp_path, trip, [0.0], [1.0], time=None)
    recording = speed_from(tmp_path, trip, [0.0], [9.0], time=None, rate_hz=1.0)
    assert clock(recording)[recording.usable][-1] == 1.0


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("seconds", "speed", "source", "message"),
    [
        ([0.0, 1, 1], [1.0, 1, 1], {}, "`speed`: times must rise, but 1 s follows 1 s"),
        pytest.param(
            [0.0, np.nan, 2],
            [1.0, 1, 1],
            {},
            "`speed`: its times hold an empty",
            marks=pytest.mark.slow,
        ),
        ([0.0, 1, 2], [1.0, 1, 1], {"rate_hz": 2.0}, "`speed`: `rate_hz` says 2 Hz, its times"),
        ([0.0, 1, 2], [-1.0, 300, np.nan], {}, "`speed` is never between 0 and 150 m/s"),
        pytest.param(
            [900.0, 901],
            [9.0, 9],
            {},
            "`speed` is never between 0 and 150 m/s while",
            marks=pytest.mark.slow,
        ),
        ([0.0, 1], [9.0, 9], {"column": "w"}, r"speed\.parquet has no column 'w'"),
    ],
)
def test_wrong_speed_is_named(tmp_path, trip, seconds, speed, source, message):
    with pytest.raises(TripError, match=message):
        speed_from(tmp_path, trip, seconds, speed, **source)


# --- a sensor on the left and one on the right ------------------------------------------------


SINGLE = {"file": "single.parquet", "column": "a", "unit": "m/s2", "rate_hz": 500.0}


def paired(path: Path, name: str, right: np.ndarray, times=None, **changes) -> Path:
    """Give a channel of a trip a second sensor, on the right."""
    content = yaml.safe_load(path.read_text())
    first = content["channels"][name]
    second = {key: value for key, value in (SINGLE | changes).items() if value is not None}
    columns = {"a": right} | ({} if times is None else {"t": times})
    pq.write_table(pa.table(columns), path.parent / second["file"], use_dictionary=False)
    content["channels"][name] = [first, second]
    path.write_text(yaml.safe_dump(content))
    return path


def roll(times_s: np.ndarray) -> np.ndarray:
    return 0.3 * np.cos(2 * np.pi * 3.1 * times_s + 1)


@pytest.mark.parametrize("rate_hz", [pytest.param(250.0, marks=pytest.mark.slow), 1000.3])
def test_pair_is_averaged_whatever_its_clocks_rates_units_and_signs(trip, rate_hz):
    at = 0.2517 + np.arange(int(66 * rate_hz)) / rate_hz
    left = samples("bogie")
    path = trip(signals={"bogie": motion(left) + roll(left)})
    right = -(motion(at) - roll(at)) / 9.80665
    path = paired(path, "bogie", right, rate_hz=rate_hz, unit="g", sign=-1, start_s=0.2517)
    recording = load(path)
    assert recording.paired == (False, True, False)
    assert recording.differences.shape == (1, len(recording.usable))
    assert recording.usable.all()
    np.testing.assert_allclose(recording.signals[1], motion(clock(recording)), atol=3e-4)
    np.testing.assert_allclose(recording.differences[0], roll(clock(recording)), atol=3e-4)
    np.testing.assert_allclose(recording.signals[0], recording.signals[1], atol=3e-4)


def test_second_sensor_with_times_may_start_later(trip):
    at = 2.0 + samples("bogie")
    path = paired(trip(duration_s=66.0), "body", motion(at), at, rate_hz=None, time="t")
    recording = load(path)
    assert 2.0 < recording.start_s < 2.2
    np.testing.assert_allclose(recording.signals[2], motion(clock(recording)), atol=3e-4)
    np.testing.assert_allclose(recording.differences, 0, atol=3e-4)


def test_single_sensors_have_no_difference(trip):
    recording = load(trip())
    assert recording.paired == (False, False, False)
    assert recording.differences.shape == (0, len(recording.usable))


def test_gap_in_one_sensor_of_a_pair_is_unusable(trip):
    at = np.arange(int(64 * 500.0)) / 500
    values = motion(at)
    values[10_000:11_000] = np.nan
    recording = load(paired(trip(), "axle_box", values))
    here = clock(recording)
    assert not recording.usable[(here > 20) & (here < 22)].any()
    assert recording.usable[(here < 19.8) | (here > 22.2)].all()
    assert [str(fault) for fault in recording.faults] == [
        "axle_box right: gap of 1000 samples (2 s), first at 20.000 s, not usable"
    ]


@pytest.mark.parametrize(
    ("right", "reason"),
    [
        (np.full(32_000, 2.0), r"it is constant (2) throughout: is the sensor connected?"),
        (np.full(32_000, np.nan), "it has no usable sample: body right: gap of 32000 samples"),
        (motion(np.arange(5000) / 500), "it is usable for 10 s only, the other one for 64 s"),
    ],
)
def test_dead_sensor_of_a_pair_is_left_out(trip, right, reason):
    recording = load(paired(trip(), "body", right))
    words = "body right: dead and left out, body is read by its left sensor alone: "
    assert words + reason in "; ".join(map(str, recording.faults))
    assert (recording.dead, recording.sides) == (("body right",), (None, None, "left"))
    assert list(recording.sensors()) == ["axle_box", "bogie", "body left"]
    assert recording.paired == (False, False, False)
    assert recording.usable.all()
    assert recording.duration_s > 63
    np.testing.assert_allclose(recording.signals[2], motion(clock(recording)), atol=3e-4)


def test_pair_of_dead_sensors_is_refused(trip):
    dead = np.full(32_000, 2.0)
    path = paired(trip(signals={"body": dead}), "body", dead)
    with pytest.raises(TripError, match=r"'body left' is constant .*\(and 1 more") as caught:
        load(path)
    assert "'body right' is constant" in caught.value.problems[1]


def elsewhere(path: Path, **signals: np.ndarray) -> Path:
    """Add sensors at the bogie's other axle to a trip, by the names of their channels."""
    content = yaml.safe_load(path.read_text())
    for channel, values in signals.items():
        file = f"{channel}_axle2.parquet"
        pq.write_table(pa.table({"a": values}), path.parent / file)
        other = {"file": file, "column": "a", "unit": "m/s2", "rate_hz": 500.0, "axle": 2}
        content["channels"][channel] = [content["channels"][channel], other]
    path.write_text(yaml.safe_dump(content))
    return path


def test_sensors_of_the_other_axle_are_part_of_no_channel(trip):
    alone, late = load(trip()), motion(np.arange(32_000) / 500 - 0.04)
    recording = load(elsewhere(trip(), axle_box=late, bogie=late))
    np.testing.assert_array_equal(recording.signals, alone.signals)
    assert recording.paired == (False, False, False)
    assert recording.sides == (None, None, None)
    assert list(recording.sensors()) == [*CHANNELS, "axle_box axle2", "bogie axle2"]
    expected = motion(clock(recording) - 0.04)
    for signal in recording.elsewhere.values():
        np.testing.assert_allclose(signal, expected, atol=3e-4)


def test_a_dead_single_sensor_is_left_out_if_four_others_are_there(trip):
    other = motion(np.arange(32_000) / 500)
    path = trip(signals={"body": np.full(127_980, 2.0)})
    with pytest.raises(TripError, match="channel 'body' is constant"):
        load_recording(read_manifest(elsewhere(path, axle_box=other)))
    path = trip(signals={"body": np.full(127_980, 2.0)})
    recording = load_recording(read_manifest(elsewhere(path, axle_box=other, bogie=other)))
    assert "body: dead and left out: it is constant (2)" in str(recording.faults[0])
    assert (recording.dead, recording.absent) == (("body",), ("body",))
    assert list(recording.sensors()) == ["axle_box", "bogie", "axle_box axle2", "bogie axle2"]
    assert np.isnan(recording.signals[2]).all()
    assert recording.usable.all()


def test_a_dead_sensor_of_the_other_axle_leaves_the_channels_as_they_are(trip):
    path = elsewhere(trip(), axle_box=np.full(32_000, 2.0), bogie=motion(np.arange(32_000) / 500))
    recording = load(path)
    assert (recording.dead, recording.absent) == (("axle_box axle2",), ())
    assert list(recording.sensors()) == [*CHANNELS, "bogie axle2"]


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("right", "changes", "message"),
    [
        pytest.param(np.empty(0), {}, r"single\.parquet is empty", marks=pytest.mark.slow),
        (np.ones(3200), {"rate_hz": 50.0}, "channel 'body right' has 50 Hz; at least 100 Hz"),
        (motion(np.arange(32_000) / 500), {"column": "b"}, r"single\.parquet has no column 'b'"),
    ],
)
def test_bad_sensor_of_a_pair_is_named(trip, right, changes, message):
    with pytest.raises(TripError, match=message):
        load(paired(trip(), "body", right, **changes))


# --- failure ---------------------------------------------------------------------------------


def test_short_trip_is_refused(trip):
    with pytest.raises(TripError, match=r"only 10\.0 s are common to all channels; at least 60 s"):
        load(trip(duration_s=10.0))
    with pytest.raises(TripError, match=r"only 0\.0 s .*\(axle_box from 0\.0 to 64\.0 s, bogie"):
        load(trip(body={"start_s": 100.0}))
    assert load(trip(duration_s=60.0)).duration_s > 59.8


@pytest.mark.parametrize("value", [pytest.param(0.0, marks=pytest.mark.slow), -3.5])
def test_dead_channel_is_refused(trip, value):
    dead = np.full(int(DURATION_S * RATES["body"]), value)
    message = rf"channel 'body' is constant \({value:g}\) throughout: is the sensor connected\?"
    with pytest.raises(TripError, match=message):
        load(trip(signals={"body": dead}))


def test_channel_without_a_good_sample_is_refused(trip):
    nothing = np.full(len(samples("bogie")), np.nan)
    with pytest.raises(TripError, match="channel 'bogie' has no usable sample: bogie: gap of 128"):
        load(trip(signals={"bogie": nothing}))


def test_channels_that_are_never_good_together_are_refused(trip):
    values = {name: motion(samples(name)) for name in CHANNELS}
    values["axle_box"][: 33 * 2000] = np.nan
    values["bogie"][32 * 2000 :] = np.nan
    with pytest.raises(TripError, match="at no time are all channels and the speed usable: axle"):
        load(trip(signals=values))


def test_empty_and_single_channels_are_refused(trip):
    with pytest.raises(TripError, match=r"body\.parquet is empty: its columns hold no samples"):
        load(trip(signals={"body": np.empty(0)}))
    with pytest.raises(TripError, match="channel 'body' has fewer than two samples"):
        load(trip(signals={"body": np.ones(1)}, body={"rate_hz": None, "time": "t"}))


def test_rates_are_checked(trip):
    with pytest.raises(TripError, match="`rate_hz` says 2000 Hz, its times say 1950 Hz"):
        load(trip(times={"bogie": np.arange(200_000) / 1950}, bogie={"time": "t"}))
    with pytest.raises(TripError, match="channel 'body' has 50 Hz; at least 100 Hz are needed"):
        load(trip(body={"rate_hz": 50.0}))
    with pytest.raises(ValueError, match="`rate_hz` must be a finite number > 0, got 0"):
        load(trip(), rate_hz=0.0)


def test_faults_of_all_sensors_and_of_the_speed_are_told_at_once(trip):
    path = trip(
        signals={"bogie": np.full(128_000, 0.5)},
        axle_box={"column": "b"},
        body={"rate_hz": 50.0},
        speed={"file": "body.parquet", "column": "v", "unit": "m/s", "rate_hz": 1.0},
    )
    with pytest.raises(TripError, match=r"no column .*\(and 3 more: suspnet check") as caught:
        load(path)
    words = ("no column 'v'", "no column 'b'", "is constant", "has 50 Hz")
    assert all(word in told for word, told in zip(words, caught.value.problems, strict=True))


# --- samples that cannot be right ------------------------------------------------------------


def own_motions(n: int) -> dict[str, np.ndarray]:
    """Return a motion of each channel, of which half is that of all."""
    shared, *own = np.random.default_rng(5).standard_normal((4, n)).cumsum(axis=1)
    return {name: shared + (x - x.mean()) for name, x in zip(CHANNELS, own, strict=True)}


def quantised(values: np.ndarray, n_bits: int) -> np.ndarray:
    step = np.abs(values).max() / 2 ** (n_bits - 1)
    return step * np.round(values / step)


COPIES = {
    "same": (lambda x: x, ""),
    "gain": (lambda x: 2.5 * x, ", times 2.5"),
    "sign and offset": (lambda x: 7.0 - x, ", times -1"),
    "16 bits": (lambda x: quantised(3 * x, 16), ", times 3"),
}


@pytest.mark.parametrize("copied", COPIES)
def test_two_channels_with_the_same_samples_are_named_and_refused(trip, copied):
    make, times = COPIES[copied]
    signals = own_motions(int(DURATION_S * 2000))
    signals["body"] = make(signals["axle_box"])
    path = trip(signals=signals, body={"rate_hz": 2000.0})
    words = f"axle_box and body hold the same samples{times}; was a file copied, or a column named"
    recording = load(path)
    for read in (recording_segments, sensor_segments):
        with pytest.raises(TripError, match=words) as refused:
            read(recording, Welch(10.0))
        assert len(refused.value.problems) == 1
    (problem,) = check_trip(path, CheckSettings({})).problems
    assert problem.startswith(words)


@pytest.mark.parametrize("noise", [1e-2, 1.0])
def test_two_sensors_of_nearly_the_same_motion_are_read(trip, noise):
    """40 dB of noise, or a motion of its own, is enough; and a sensor of a constant is dead."""
    signals = own_motions(int(DURATION_S * 2000))
    x = signals["axle_box"]
    own = np.random.default_rng(6).standard_normal(len(x)).cumsum()
    signals["body"] = 2 * x + 2 * noise * x.std() / own.std() * own
    recording = load(trip(signals=signals, body={"rate_hz": 2000.0}))
    assert len(recording_segments(recording, Welch(10.0)).values)


@pytest.mark.parametrize(("unit", "gravity"), [("g", 1000.0), ("m/s2", 1e6)])
def test_impossible_mean_asks_for_the_unit(trip, unit, gravity):
    values = gravity + motion_at(RATES["body"], DURATION_S, 0.0)
    with pytest.raises(
        TripError, match=r"body.* mean of \S+ m/s2, gravity is 9\.81: is its unit mg"
    ):
        load(trip(signals={"body": values}, body={"unit": unit}))


@pytest.mark.parametrize(
    ("mean", "words"), [(9.81, "9.81 m/s2, harmless"), (-96.0, "-96 m/s2, gravity is 9.81: check")]
)
def test_mean_above_gravity_is_doubted(trip, mean, words):
    values = mean + motion_at(RATES["body"], DURATION_S, 0.0)
    (fault,) = load(trip(signals={"body": values})).faults
    assert str(fault).startswith(f"body: offset of {words}")
