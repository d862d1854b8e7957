"""Later records relative to healthy ones, and the files of a commissioned rig."""

import json
import math

import numpy as np
import pytest
from rig_records import numbers, record
from scipy.stats import t

from suspnet import (
    ModelFileError,
    NoEstimateError,
    Rig,
    RigRecord,
    commission_rig,
    load_model,
    load_rig,
    read_rig,
    save_rig,
)
from suspnet.estimation.commissioned_rig import BANDS, RATIOS, CommissionedRig, RigReading
from suspnet.ground.parameters import Severity
from suspnet.ground.storage import content_hash

WORN = np.array([0.8, 0.6, 0.9, 0.5, 1.1])


def made_up(n):
    """Return a rig and n readings of numbers that scatter."""
    rng = np.random.default_rng(n)
    readings = []
    for _ in range(n):
        root = 0.01 * rng.standard_normal((5, 5))
        readings.append(
            RigReading(
                0.05 * rng.standard_normal(5),
                root @ root.T + 1e-4 * np.eye(5),
                0.01 * rng.standard_normal((BANDS, 5)),
                0.1 * rng.random((4, 3)),
                *(1.0, 2.0, 0.1, True),
            )
        )
    return Rig("bench", 20.0, 25.0), tuple(readings)


def test_intervals_are_those_of_the_docstring():
    rig, (later, *healthy) = made_up(5)
    n = len(healthy)
    commissioned = CommissionedRig(rig, 3.0, 3.0, 40.0, tuple("abcd"), tuple(healthy))
    found = commissioned.estimate(later, level=0.8).ratios["k_s_over_M_s"]

    def change(one, others):
        logs = one.logs - sum(o.logs for o in others) / len(others)
        c = one.covariance + sum(o.covariance for o in others) / len(others) ** 2
        d = one.influences - sum(o.influences for o in others) / len(others)
        of_noise = c[2, 2] + c[4, 4] - 2 * c[2, 4]
        of_bands = sum((row[2] - row[4]) ** 2 for row in d)
        return logs[2] - logs[4], max(of_noise, of_bands)

    excess = []
    for i in range(n):
        d, v = change(healthy[i], healthy[:i] + healthy[i + 1 :])
        excess.append(d**2 - v)
    scatter = max(0.0, sum(excess) / n) * (1 + 1 / n) / (1 + 1 / (n - 1))
    assert scatter > 0
    d, v = change(later, healthy)
    half = t.ppf(0.9, n - 1) * math.sqrt(v + scatter)
    assert found.value == pytest.approx(math.exp(d))
    assert (found.low, found.high) == pytest.approx((math.exp(d - half), math.exp(d + half)))


def test_worn_rig_is_read(bench):
    true, _, _, commissioned = bench
    signals = record(true * WORN, 200.0, 24.0, 100)
    estimate = read_rig(commissioned, RigRecord(signals, 200.0))
    for name, ratio in zip(("k_p", "c_p", "k_s", "c_s", "M_s"), WORN, strict=True):
        value = estimate.ratios[name]
        assert value.low < ratio < value.high
        assert value.high / value.low < (1.02 if name in ("k_p", "k_s", "M_s") else 1.4)
    assert estimate.severity == Severity.ACT
    assert estimate.severities == {
        "k_p": Severity.NOTICE,  # at the act limit itself
        "c_p": Severity.ACT,
        "k_s": Severity.NONE,
        "c_s": Severity.ACT,
    } | {name: s for name, s in estimate.severities.items() if name in ("k_p", "k_s")}
    assert estimate.values["mass_ratio"].value == pytest.approx(0.88, rel=0.01)


def test_healthy_records_are_healthy(bench):
    *_, commissioned = bench
    for i in range(3):
        estimate = commissioned.estimate_healthy(i)
        assert estimate.severity == Severity.NONE
        assert all(v.low < 1 < v.high for v in estimate.ratios.values())


def test_healthy_numbers_are_those_of_the_rig(bench):
    *_, commissioned = bench
    healthy = commissioned.healthy()
    expected = {"primary_hz": 20.0, "secondary_hz": 25.0, "mass_ratio": 0.8}
    for name, number in expected.items():
        assert healthy[name].low < number < healthy[name].high


def test_wear_is_read_on_a_rig_with_more_than_two_masses(bench):
    true, rig, *_ = bench

    def recorded(numbers, seed):
        return RigRecord(record(numbers, 200.0, 24.0, seed, hung=(0.04, 15.0, 0.02)), 200.0)

    commissioned = commission_rig(rig, [recorded(true, i) for i in range(3)])
    estimate = read_rig(commissioned, recorded(true * WORN, 100))
    assert commissioned.misfit > 10
    for name, ratio in zip(("k_p", "k_s", "c_s", "M_s"), WORN[[0, 2, 3, 4]], strict=True):
        assert estimate.ratios[name].low < ratio < estimate.ratios[name].high
    assert estimate.ratios["k_p"].high < 0.95
    assert commissioned.estimate_healthy(0).severity == Severity.NONE


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate_hz", "stated", "seconds", "hung"),
    [
        (2000.0, (200.0, 260.0, 1.3, 0.01, 0.02), 10.0, None),
        (20.0, (3.0, 1.2, 3.0, 0.05, 0.15), 300.0, None),
        (200.0, (11.0, 1.4, 7.0, 0.02, 0.25), 150.0, None),
        (120.0, (15.0, 20.0, 0.8, 0.01, 0.01), 80.0, (0.05, 14.0, 0.02)),
    ],
    ids=["kHz", "slow", "car", "hung equipment"],
)
def test_intervals_hold_on_rigs_that_nobody_tuned_to(rate_hz, stated, seconds, hung):
    inside = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        true = numbers(*(np.array(stated) * np.exp(0.05 * rng.standard_normal(5))))
        rig = Rig("rig", *(np.array(stated) * np.exp(0.3 * rng.standard_normal(5))))

        def recorded(true, i, seed=seed):
            signals = record(true, rate_hz, seconds, 100 * seed + i, hung=hung)
            return RigRecord(signals, rate_hz)

        commissioned = commission_rig(rig, [recorded(true, i) for i in range(4)])
        wear = np.exp(np.array([-0.3, -0.5, -0.2, -0.6, 0.1]) * rng.random(5))
        for i, ratios in enumerate((np.ones(5), wear)):
            found = read_rig(commissioned, recorded(true * ratios, 50 + i)).ratios
            for name, direction in RATIOS.items():
                truth = math.exp(np.dot(direction, np.log(ratios)))
                inside.append(found[name].low < truth < found[name].high)
    assert np.mean(inside) > 0.85


def test_record_that_shows_nothing_has_no_estimate(bench):
    *_, commissioned = bench
    noise = np.random.default_rng(0).standard_normal((3, 4800))
    with pytest.raises(NoEstimateError, match=r"does not show k_[ps] \(between"):
        read_rig(commissioned, RigRecord(noise, 200.0))


def test_slowly_sampled_records_are_refused(bench):
    _, rig, records, commissioned = bench
    slow = RigRecord(records[0].signals[:, ::2], 100.0)
    with pytest.raises(NoEstimateError, match=r"is sampled at 100 Hz; the band up to"):
        read_rig(commissioned, slow)
    slower = [RigRecord(record.signals[:, ::8], 25.0) for record in records]
    with pytest.raises(NoEstimateError, match="a quarter of their rate; the first mode"):
        commission_rig(rig, slower)


def test_two_records_are_too_few(bench):
    _, rig, records, _ = bench
    with pytest.raises(ValueError, match="2 healthy records are given, at least 3"):
        commission_rig(rig, records[:2])


@pytest.mark.parametrize(
    ("signals", "words"),
    [
        (np.ones((2, 9)), r"must be base, frame and body, of shape \(3, n\), got \(2, 9\)"),
        (np.full((3, 9), np.nan), "hold NaN"),
        (np.array([[1.0, 2.0], [1.0, 1.0], [1.0, 2.0]]), "frame is constant"),
    ],
)
def test_wrong_signals_are_refused(signals, words):
    with pytest.raises(ValueError, match=words):
        RigRecord(signals, 100.0)


def test_rig_is_stored_and_loaded(bench, tmp_path):
    true, _, _, commissioned = bench
    save_rig(tmp_path, commissioned)
    loaded = load_rig(tmp_path)
    later = RigRecord(record(true * WORN, 200.0, 24.0, 100), 200.0)
    assert read_rig(loaded, later) == read_rig(commissioned, later)
    assert loaded.rig == commissioned.rig
    with pytest.raises(FileNotFoundError, match=r"no model\.json"):
        load_model(tmp_path)


def test_missing_rig_is_reported(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no rig\.json"):
        load_rig(tmp_path)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content.update(schema_version=99), "schema version"),
        (lambda content: content.update(segment_s=-1.0), "segment_s"),
        (lambda content: content["rig"].update(primary_hz=0.0), "primary_hz"),
        (lambda content: content["rig"].update(kind="os.system"), "kind"),
        (lambda content: content["readings"].pop(), "zip"),
        (lambda content: content["readings"][0].update(misfit=-1.0), "misfit"),
        (lambda content: content.update(records=["a"]), "1 healthy records"),
        (lambda content: content.update(records=[1, 2, 3]), "names"),
        (lambda content: content["readings"][0].update(logs=[1.0]), r"shape \(5,\)"),
        (lambda content: content["readings"][0].update(errors=[[-1.0] * 3]), "errors"),
        (lambda content: content["readings"][0]["covariance"][0].__setitem__(1, 1.0), "definite"),
    ],
)
def test_forged_rigs_are_refused(bench, tmp_path, change, words):
    *_, commissioned = bench
    save_rig(tmp_path, commissioned)
    path = tmp_path / "rig.json"
    content = json.loads(path.read_text())
    del content["description_sha256"]
    change(content)
    content["description_sha256"] = content_hash(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ModelFileError, match=words):
        load_rig(tmp_path)


def test_altered_files_are_refused(bench, tmp_path):
    *_, commissioned = bench
    save_rig(tmp_path, commissioned)
    (tmp_path / "rig.json").write_text(
        (tmp_path / "rig.json").read_text().replace("bench", "bunch")
    )
    with pytest.raises(ModelFileError, match="damaged or was altered"):
        load_rig(tmp_path)
