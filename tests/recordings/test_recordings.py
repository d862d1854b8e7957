"""Whole trips from files: one clock, known signals back, faults marked, mistakes named."""

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from suspnet.curves.welch import Welch
from suspnet.trains.jobs.check import CheckSettings, check_trip
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import Recording, load_recording
from suspnet.trains.spectra.segments import recording_segments, sensor_segments

FREQUENCIES_HZ = np.array([0.5, 1.3, 4.0, 7.7, 12.0, 20.0, 25.0])
PHASES = np.arange(7) ** 2.0
RATES = {"axle_box": 2000.0, "bogie": 2000.0, "body": 1999.7}
DURATION_S = 64.0
SINGLE = {"file": "single.parquet", "column": "a", "unit": "m/s2", "rate_hz": 500.0}
N_SINGLE = 32_000


def motion(times_s: np.ndarray) -> np.ndarray:
    """Return a sum of sinusoids in the pass band, [m/s2]."""
    return np.cos(2 * np.pi * times_s[:, None] * FREQUENCIES_HZ + PHASES).sum(axis=1)


@cache
def motion_at(rate_hz: float, duration_s: float, start_s: float) -> np.ndarray:
    return motion(np.arange(int(duration_s * rate_hz)) / rate_hz + start_s)


def samples(name: str, duration_s: float = DURATION_S) -> np.ndarray:
    return np.arange(int(duration_s * RATES[name])) / RATES[name]


MOTION = {name: motion(samples(name)) for name in CHANNELS}
SINGLE_S = np.arange(N_SINGLE) / 500
DEAD = np.full(N_SINGLE, 2.0)


def write_columns(path: Path, **columns) -> None:
    options = {"row_group_size": 2**16, "use_dictionary": False}  # many times faster
    pq.write_table(pa.table(columns), path, **options)


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
            at = (times or {}).get(name, np.arange(int(duration_s * rate_hz)) / rate_hz)
            values = motion_at(rate_hz, duration_s, channel.get("start_s", 0.0))
            values = (signals or {}).get(name, values)
            write_columns(tmp_path / channel["file"], t=at[: len(values)], a=values)
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


def assert_motion(recording: Recording, *signals, atol: float = 3e-4, of=motion) -> None:
    """Check that signals are a motion at the instants of the common clock."""
    for signal in signals:
        np.testing.assert_allclose(signal, of(clock(recording)), atol=atol)


def speed_from(tmp_path: Path, trip, seconds, speed, **source) -> Recording:
    write_columns(tmp_path / "speed.parquet", t=seconds, v=speed)
    source = {"file": "speed.parquet", "column": "v", "unit": "m/s", "time": "t"} | source
    return load(trip(speed={key: value for key, value in source.items() if value is not None}))


def paired(path: Path, name: str, right: np.ndarray, times=None, **changes) -> Path:
    """Give a channel of a trip a second sensor, on the right."""
    content = yaml.safe_load(path.read_text())
    second = {key: value for key, value in (SINGLE | changes).items() if value is not None}
    write_columns(path.parent / second["file"], a=right, **({} if times is None else {"t": times}))
    content["channels"][name] = [content["channels"][name], second]
    path.write_text(yaml.safe_dump(content))
    return path


def elsewhere(path: Path, **signals: np.ndarray) -> Path:
    """Add sensors at the bogie's other axle to a trip, by the names of their channels."""
    content = yaml.safe_load(path.read_text())
    for channel, values in signals.items():
        file = f"{channel}_axle2.parquet"
        write_columns(path.parent / file, a=values)
        content["channels"][channel] = [
            content["channels"][channel],
            SINGLE | {"file": file, "axle": 2},
        ]
    path.write_text(yaml.safe_dump(content))
    return path


# --- reference: known motion comes back ------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [100.0, pytest.param(128.0, marks=pytest.mark.slow)])
def test_all_channels_give_the_same_motion_on_one_clock(trip, rate_hz):
    recording = load(trip(body={"rate_hz": None, "time": "t"}), rate_hz=rate_hz)
    assert DURATION_S - 0.3 < recording.duration_s < DURATION_S
    assert recording.usable.all()
    assert recording.faults == ()
    assert (recording.speed_m_per_s == 30.0).all()
    assert (recording.paired, recording.differences.size) == ((False, False, False), 0)
    assert_motion(recording, *recording.signals, atol=2e-4)


@pytest.mark.parametrize("rate_hz", [100.0, pytest.param(2048.0, marks=pytest.mark.slow), 5120.0])
def test_other_rates_and_a_bogie_that_has_only_times(trip, rate_hz):
    recording = load(trip(axle_box={"rate_hz": rate_hz}, bogie={"time": "t", "rate_hz": None}))
    np.testing.assert_allclose(recording.signals[0], recording.signals[1], atol=2e-4)


def test_starts_put_channels_on_one_clock(trip):
    starts = {"axle_box": {"start_s": 0.33371}, "bogie": {"start_s": 1.25}}
    recording = load(trip(**starts, body={"start_s": -0.5, "time": "t"}, duration_s=65.0))
    assert 1.25 < recording.start_s < 1.4
    assert clock(recording)[-1] < 64.5
    assert_motion(recording, *recording.signals, atol=2e-4)


def test_unit_sign_and_range_are_applied(trip):
    recording = load(trip(bogie={"unit": "g", "sign": -1}))
    np.testing.assert_allclose(recording.signals[1], -9.80665 * recording.signals[0], atol=2e-3)
    signals = {"bogie": np.clip(MOTION["bogie"], -4, 4)}
    assert load(trip(signals, bogie={"unit": "g", "range": 4.5})).usable.all()
    recording = load(trip(signals, bogie={"unit": "g", "range": 4.0}))
    assert {fault.kind for fault in recording.faults} == {"saturation"}
    assert 0.1 < recording.usable.mean() < 0.9


# --- faults ----------------------------------------------------------------------------------


def test_lost_samples_keep_the_clock_and_are_marked(trip):
    """A logger that drops two seconds, then one sample; only its time stamps show it."""
    times = samples("body")
    kept = np.ones(len(times), dtype=bool)
    kept[40_000:44_000] = kept[90_000] = False
    path = trip({"body": MOTION["body"][kept]}, {"body": times[kept]}, body={"time": "t"})
    recording = load(path)
    at, usable = clock(recording), recording.usable
    lost = (at > times[40_000] - 0.1) & (at < times[44_000] + 0.1)
    assert usable[~lost].all()
    assert not usable[(at > times[40_000]) & (at < times[44_000])].any()
    np.testing.assert_allclose(recording.signals[2, usable], motion(at[usable]), atol=2e-4)
    faults = [(fault.kind, fault.n_samples, fault.repaired) for fault in recording.faults]
    assert faults == [("gap", 1, True), ("gap", 4000, False)]
    assert recording.faults[1].first_s == pytest.approx(times[40_000])


def test_faults_of_each_channel_are_listed_and_repaired(trip):
    values = {name: signal.copy() for name, signal in MOTION.items()}
    values["axle_box"][40_000] = 5e3
    values["bogie"][50_000:50_002] = np.nan
    values["body"][70_000:72_000] = values["body"][70_000]
    values["body"] += 9.80665
    recording = load(trip(values))
    assert [(f.channel, f.kind, f.repaired) for f in recording.faults] == [
        ("axle_box", "spike", True),
        ("bogie", "gap", True),
        ("body", "constant", False),
        ("body", "offset", True),
    ]
    at = clock(recording)
    assert recording.usable[(at < 34.9) | (at > 36.2)].all()
    assert not recording.usable[(at > 35.01) & (at < 36.0)].any()
    assert_motion(recording, *recording.signals[:2])


# --- speed -----------------------------------------------------------------------------------


def test_speed_is_interpolated_in_its_unit(tmp_path, trip):
    seconds = np.arange(70.0)
    recording = speed_from(tmp_path, trip, seconds, 36 + 3.6 * seconds, unit="km/h")
    np.testing.assert_allclose(recording.speed_m_per_s, 10 + clock(recording))
    timing = {"time": None, "rate_hz": 2.0, "start_s": 35.0}
    recording = speed_from(tmp_path, trip, seconds, seconds, **timing)
    at, usable = clock(recording), recording.usable
    np.testing.assert_allclose(
        recording.speed_m_per_s[usable], np.maximum(2 * (at[usable] - 35), 0)
    )
    np.testing.assert_array_equal(usable, at >= 34.5 - 1e-9)


def test_speed_is_unknown_next_to_wrong_values_and_in_long_gaps(tmp_path, trip):
    seconds = np.concatenate([np.arange(30.0), np.arange(45.0, 64.0)])
    speed = np.full(len(seconds), 20.0)
    speed[[5, 10, 15]] = [np.nan, -1.0, 1e4]
    recording = speed_from(tmp_path, trip, seconds, speed)
    at, known = clock(recording), np.isfinite(recording.speed_m_per_s)
    for start, stop in ((4, 6), (9, 11), (14, 16), (29, 45)):
        assert not known[(at > start + 1e-6) & (at < stop - 1e-6)].any()
        assert known[(at > stop + 0.01) & (at < stop + 2.9)].all()
    assert known[at < 4 - 1e-6].all()
    np.testing.assert_array_equal(recording.usable, known)


@pytest.mark.representatives(3)
@pytest.mark.parametrize(
    ("seconds", "speed", "source", "message"),
    [
        ([0.0, 1, 1], [1.0, 1, 1], {}, "`speed`: times must rise, but 1 s follows 1 s"),
        ([0.0, np.inf, 2], [1.0, 1, 1], {}, "`speed`: its times hold an empty or infinite"),
        ([0.0, 1, 2], [1.0, 1, 1], {"rate_hz": 2.0}, "`speed`: `rate_hz` says 2 Hz, its times"),
        ([0.0, 1, 2], [-1.0, 300, np.nan], {}, "`speed` is never between 0 and 150 m/s"),
        ([900.0, 901], [9.0, 9], {}, "`speed` is never between 0 and 150 m/s while"),
        ([0.0, 1], [9.0, 9], {"column": "w"}, r"speed\.parquet has no column 'w'"),
        ([0.0], [1.0], {"time": None}, "`speed` needs `rate_hz` or `time`"),
    ],
)
def test_wrong_speed_is_named(tmp_path, trip, seconds, speed, source, message):
    with pytest.raises(TripError, match=message):
        speed_from(tmp_path, trip, seconds, speed, **source)


# --- a sensor on the left and one on the right ------------------------------------------------


def roll(times_s: np.ndarray) -> np.ndarray:
    return 0.3 * np.cos(2 * np.pi * 3.1 * times_s + 1)


@pytest.mark.parametrize("rate_hz", [pytest.param(250.0, marks=pytest.mark.slow), 1000.3])
def test_pair_is_averaged_whatever_its_clocks_rates_units_and_signs(trip, rate_hz):
    at = 0.2517 + np.arange(int(66 * rate_hz)) / rate_hz
    path = trip({"bogie": MOTION["bogie"] + roll(samples("bogie"))})
    right = -(motion(at) - roll(at)) / 9.80665
    path = paired(path, "bogie", right, rate_hz=rate_hz, unit="g", sign=-1, start_s=0.2517)
    recording = load(path)
    assert recording.paired == (False, True, False)
    assert recording.usable.all()
    assert_motion(recording, *recording.signals[:2])
    assert_motion(recording, *recording.differences, of=roll)


def test_gap_in_one_sensor_of_a_pair_is_unusable(trip):
    values = motion(SINGLE_S)
    values[10_000:11_000] = np.nan
    recording = load(paired(trip(), "axle_box", values))
    at = clock(recording)
    assert not recording.usable[(at > 20) & (at < 22)].any()
    assert recording.usable[(at < 19.8) | (at > 22.2)].all()
    (fault,) = recording.faults
    assert (fault.channel, fault.kind, fault.seconds) == ("axle_box right", "gap", 2.0)


@pytest.mark.parametrize(
    ("right", "reason"),
    [
        (DEAD, "it is constant (2) throughout"),
        (np.full(N_SINGLE, np.nan), "it has no usable sample: body right: gap of 32000 samples"),
        (motion(SINGLE_S[:5000]), "it is usable for 10 s only, the other one for 64 s"),
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
    assert_motion(recording, recording.signals[2])


def test_pair_of_dead_sensors_is_refused(trip):
    with pytest.raises(TripError, match=r"'body left' is constant .*\(and 1 more") as caught:
        load(paired(trip({"body": DEAD}), "body", DEAD))
    assert "'body right' is constant" in caught.value.problems[1]


def test_sensors_of_the_other_axle_are_part_of_no_channel(trip):
    alone, late = load(trip()), motion(SINGLE_S - 0.04)
    recording = load(elsewhere(trip(), axle_box=late, bogie=late))
    np.testing.assert_array_equal(recording.signals, alone.signals)
    assert recording.paired == (False, False, False)
    assert recording.sides == (None, None, None)
    assert list(recording.sensors()) == [*CHANNELS, "axle_box axle2", "bogie axle2"]
    assert_motion(recording, *recording.elsewhere.values(), of=lambda at: motion(at - 0.04))


def test_a_dead_single_sensor_is_left_out_if_there_are_four_others(trip):
    other, dead = motion(SINGLE_S), {"body": np.full(127_980, 2.0)}
    with pytest.raises(TripError, match="channel 'body' is constant"):
        load(elsewhere(trip(dead), axle_box=other))
    path = elsewhere(trip(dead), axle_box=other, bogie=other)
    recording = load_recording(read_manifest(path))
    assert "body: dead and left out: it is constant (2)" in str(recording.faults[0])
    assert (recording.dead, recording.absent) == (("body",), ("body",))
    assert list(recording.sensors()) == ["axle_box", "bogie", "axle_box axle2", "bogie axle2"]
    assert np.isnan(recording.signals[2]).all()
    assert recording.usable.all()


def test_a_dead_sensor_of_the_other_axle_leaves_the_channels_as_they_are(trip):
    recording = load(elsewhere(trip(), axle_box=DEAD, bogie=motion(SINGLE_S)))
    assert (recording.dead, recording.absent) == (("axle_box axle2",), ())
    assert list(recording.sensors()) == [*CHANNELS, "bogie axle2"]


# --- failure ---------------------------------------------------------------------------------


def halves():
    """Return signals of which two are good in different halves of the trip only."""
    values = {name: signal.copy() for name, signal in MOTION.items()}
    values["axle_box"][: 33 * 2000] = np.nan
    values["bogie"][32 * 2000 :] = np.nan
    return values


BY_TIMES = {"rate_hz": None, "time": "t"}
REFUSED = {
    "short": ({"duration_s": 10.0}, "only 10.0 s are common to all channels; at least 60 s"),
    "late": ({"body": {"start_s": 100.0}}, "only 0.0 s are common"),
    "constant": (
        {"signals": {"body": np.full(127_980, -3.5)}},
        "channel 'body' is constant (-3.5)",
    ),
    "NaN": (
        {"signals": {"bogie": np.full(128_000, np.nan)}},
        "'bogie' has no usable sample: bogie",
    ),
    "never together": ({"signals": halves()}, "at no time are all channels and the speed usable"),
    "empty": ({"signals": {"body": np.empty(0)}}, "body.parquet is empty"),
    "one sample": ({"signals": {"body": np.ones(1)}, "body": BY_TIMES}, "fewer than two samples"),
    "slow": ({"body": {"rate_hz": 50.0}}, "channel 'body' has 50 Hz; at least 100 Hz are needed"),
    "other rate": (
        {"times": {"bogie": np.arange(200_000) / 1950}, "bogie": {"time": "t"}},
        "`rate_hz` says 2000 Hz, its times say 1950 Hz",
    ),
    "mg as g": (
        {"signals": {"body": 1000.0 + MOTION["body"]}, "body": {"unit": "g"}},
        "gravity is 9.81: is its unit mg",
    ),
}


@pytest.mark.parametrize("why", REFUSED)
def test_trips_that_cannot_be_read_are_refused(trip, why):
    changes, message = REFUSED[why]
    with pytest.raises(TripError) as caught:
        load(trip(**changes))
    assert message in str(caught.value)


def test_faults_of_all_sensors_and_of_the_speed_are_reported_at_once(trip):
    path = trip(
        signals={"bogie": np.full(128_000, 0.5)},
        axle_box={"column": "b"},
        body={"rate_hz": 50.0},
        speed={"file": "body.parquet", "column": "v", "unit": "m/s", "rate_hz": 1.0},
    )
    with pytest.raises(TripError, match=r"no column .*\(and 3 more: suspnet check") as caught:
        load(path)
    words = ("no column 'v'", "no column 'b'", "is constant", "has 50 Hz")
    assert all(word in text for word, text in zip(words, caught.value.problems, strict=True))


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
    "sign, gain and offset": (lambda x: 7.0 - 2.5 * x, ", times -2.5"),
    "16 bits": (lambda x: quantised(3 * x, 16), ", times 3"),
}


@pytest.mark.parametrize("copied", COPIES)
def test_two_channels_with_the_same_samples_are_named_and_refused(trip, copied):
    make, times = COPIES[copied]
    signals = own_motions(int(DURATION_S * 2000))
    signals["body"] = make(signals["axle_box"])
    path = trip(signals, body={"rate_hz": 2000.0})
    words = f"axle_box and body hold the same samples{times}; was a file copied"
    recording = load(path)
    for read in (recording_segments, sensor_segments):
        with pytest.raises(TripError, match=words) as refused:
            read(recording, Welch(10.0))
        assert len(refused.value.problems) == 1
    (problem,) = check_trip(path, CheckSettings({})).problems
    assert problem.startswith(words)


@pytest.mark.parametrize("noise", [1e-2, 1.0])
def test_two_sensors_of_nearly_the_same_motion_are_read(trip, noise):
    """40 dB of noise, or a motion of its own, is enough."""
    signals = own_motions(int(DURATION_S * 2000))
    x = signals["axle_box"]
    own = np.random.default_rng(6).standard_normal(len(x)).cumsum()
    signals["body"] = 2 * x + 2 * noise * x.std() / own.std() * own
    recording = load(trip(signals, body={"rate_hz": 2000.0}))
    assert len(recording_segments(recording, Welch(10.0)).values)


@pytest.mark.parametrize(
    ("mean", "words"), [(9.81, "9.81 m/s2, harmless"), (-96.0, "-96 m/s2, gravity is 9.81: check")]
)
def test_mean_above_gravity_is_doubted(trip, mean, words):
    (fault,) = load(trip({"body": mean + MOTION["body"]})).faults
    assert str(fault).startswith(f"body: offset of {words}")
