"""Readings of the paper against its Table VI."""

import json
import math

import pytest

from suspnet.runs.readings import METHODS, OUTPUTS, compare, write_readings
from suspnet.runs.tables import PUBLISHED

PUBLISHED_CELLS = {
    (*key, method): value for key, methods in PUBLISHED.items() for method, value in methods.items()
}


def runs_of(reading, factor, seed=0):
    """Runs whose errors are the published ones times a factor, on all curves and on few."""

    def scores(output, method, share):
        return {
            metric: share * factor * PUBLISHED[output, metric][method]
            for metric in ("mape_percent", "rmse")
        }

    groups = {"I": OUTPUTS[:2], "II": OUTPUTS[2:]}
    return [
        {
            "reading": reading,
            "model": method,
            "group": group,
            "seed": seed,
            "scores": {output: scores(output, method, 1) for output in outputs},
            "scores_where": {
                "varied": {output: scores(output, method, 2) for output in outputs},
                "degraded": {output: dict.fromkeys(("mape_percent", "rmse")) for output in outputs},
            },
        }
        for method in METHODS
        for group, outputs in groups.items()
    ]


def test_published_figures_are_at_no_distance_of_themselves():
    found = compare(PUBLISHED_CELLS)
    assert found["distance"] == 0
    assert (found["in_order"], found["linear_last"]) == (4, 4)
    low, high = found["rmse_over_mape"]
    assert (round(low, 3), round(high, 3)) == (0.967, 0.995)


def test_distance_is_the_mean_logarithm_of_the_ratio():
    cells = dict(PUBLISHED_CELLS)
    for output in OUTPUTS:
        cells[output, "mape_percent", "msvr"] *= 2
        cells[output, "mape_percent", "linear"] /= 8
    found = compare(cells)
    assert found["distance"] == pytest.approx((math.log(2) + math.log(8)) / 4)
    assert (found["in_order"], found["linear_last"]) == (0, 0)


def test_readings_are_ranked_by_their_distance_and_averaged_over_seeds(tmp_path):
    runs = [
        *runs_of("baseline", 3.0),
        *runs_of("near", 1.0, seed=0),
        *runs_of("near", 1.4, seed=1),
        *runs_of("unfinished", 1.0)[:-1],
    ]
    records = write_readings(runs, tmp_path)
    assert [(r["test"], r["reading"]) for r in records] == [
        ("all", "near"),
        ("all", "baseline"),
        ("varied", "near"),
        ("varied", "baseline"),
    ]
    assert records[0]["distance"] == pytest.approx(math.log(1.2))
    assert records[1]["distance"] == pytest.approx(math.log(3))
    assert records[2]["distance"] == pytest.approx(math.log(2.4))
    text = (tmp_path / "readings.md").read_text()
    assert "| the paper " in text
    assert "2 readings were compared, so the nearest is chosen after the fact" in text
    assert json.loads((tmp_path / "readings.json").read_text()) == json.loads(json.dumps(records))
    assert (tmp_path / "readings.png").is_file()
