"""The study of the tube: errors of labels, the comparison and its files, as a program."""

import csv

import numpy as np
import pytest
from cli_runner import run_composed
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from suspnet.cli import train
from suspnet.runs.tube import TubeStudy, tube_markdown, with_errors


@pytest.mark.parametrize("n_outputs", [2, 4])
@pytest.mark.parametrize("kind", ["uniform", "ball", "sphere", "steps", "normal"])
def test_errors_of_every_kind_have_the_rms_of_uniform_ones(kind, n_outputs):
    truth = np.random.default_rng(0).uniform(0.5, 2.0, (20_000, n_outputs))
    labels = with_errors(f"{kind}_10", truth, np.random.default_rng(1))
    errors = labels - truth if kind == "steps" else labels / truth - 1
    np.testing.assert_allclose(np.sqrt(np.mean(errors**2, axis=0)), 0.1 / np.sqrt(3), rtol=0.03)
    largest, lengths = np.abs(errors).max(), np.linalg.norm(errors, axis=1)
    rms = 0.1 / np.sqrt(3)
    if kind in ("uniform", "steps"):
        assert largest == pytest.approx(0.1, rel=1e-3)
    if kind == "sphere":
        np.testing.assert_allclose(lengths, rms * np.sqrt(n_outputs))
    if kind == "ball":
        assert lengths.max() == pytest.approx(rms * np.sqrt(n_outputs + 2), rel=1e-2)
    assert with_errors("exact", truth, np.random.default_rng(1)).tolist() == truth.tolist()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"labels": ["laplace_5"]}, "`labels` must be one of"),
        ({"labels": ["uniform"]}, "`labels: uniform` must be"),
        ({"n_outputs": [5]}, "`n_outputs` must be"),
        ({"n_train": [0]}, "`n_train` must be"),
    ],
)
def test_impossible_studies_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        TubeStudy(**settings)


@pytest.mark.slow
def test_study_compares_tubes_on_labels_with_errors(tmp_path):
    some = ["tube.n_train=[60]", "tube.n_outputs=[2]", "tube.n_seeds=2", "workers=1"]
    run_composed(train, tmp_path, "experiment=tube", *some, "tube.labels=[sphere_10]")
    with (tmp_path / "tube.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(r["problem"], r["labels"], r["seed"]) for r in rows] == [
        (problem, "sphere_10", seed) for problem in ("paper", "sines") for seed in "01"
    ]
    for row in rows:
        assert float(row["best_percent"]) <= float(row["joint_percent"])
        assert float(row["best_percent"]) <= float(row["ridge_percent"])
        assert 0 < float(row["separate_percent"]) < 120
    gains = [float(row["best_percent"]) / float(row["ridge_percent"]) for row in rows[-2:]]
    assert np.mean(gains) < 0.95  # labels off by a constant length
    events = EventAccumulator(str(tmp_path)).Reload().Tags()
    assert "tube/text_summary" in events["tensors"]
    assert "comparison/tube" in events["images"]
    assert (tmp_path / "tube.png").read_bytes().startswith(b"\x89PNG")


def test_table_has_the_ratios_over_seeds():
    record = {"problem": "paper", "n_outputs": 2, "labels": "steps_10", "n_train": 60}
    percents = {"ridge_percent": 10.0, "best_percent": 8.0, "separate_percent": 20.0}
    table = tube_markdown([record | percents | {"joint_percent": v} for v in (9.0, 11.0)])
    assert "steps of 20 %" in table
    assert "1.00 ± 0.14 (0.80), 0.50" in table
