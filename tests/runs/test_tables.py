"""Table VI as records, Markdown and CSV."""

import csv
import io
import math

import pytest

from suspnet.runs.tables import (
    PUBLISHED,
    records_csv,
    scores_table,
    table6_markdown,
    table6_records,
    table6_short,
)

KEYS = [
    "protocol",
    "group",
    "output",
    "metric",
    "model",
    "published",
    "measured",
    "bound",
    "n_train",
    "snr_db",
    "seed",
    "seconds",
]


def run(model, outputs, seconds=1.25, snr_db=34.0, protocol="multi_location"):
    """Return the metrics.json of one run, with a figure of its own everywhere."""
    offsets = {"msvr": 0.0, "svr": 2.0, "linear": 5.0, "linear+refine": 7.0, "curve_fit": 0.25}
    offset = offsets[model]
    return {
        "protocol": protocol,
        "model": model,
        "scores": {
            name: {"mape_percent": j + 1.5 + offset, "rmse": (j + 1 + offset) / 100}
            for j, name in enumerate(outputs)
        },
        "bound": {
            name: {"mape_percent": j + 0.125, "rmse": (j + 0.5) / 1000}
            for j, name in enumerate(outputs)
        },
        "n_train": 20_000,
        "snr_db": snr_db,
        "seed": 3,
        "seconds": seconds,
    }


@pytest.fixture
def records():
    """Both groups of two models, in an order that is not the table's."""
    return table6_records(
        [
            run("linear", ("k_s", "c_s"), seconds=0.5),
            run("msvr", ("k_s", "c_s"), seconds=2.0),
            run("linear", ("k_p", "c_p"), seconds=0.25),
            run("msvr", ("k_p", "c_p"), seconds=3.0),
        ]
    )


# reference


@pytest.mark.parametrize(
    ("output", "metric", "model", "value"),
    [
        ("k_p", "mape_percent", "msvr", 5.89),
        ("c_p", "mape_percent", "svr", 10.29),
        ("k_s", "mape_percent", "linear", 18.06),
        ("c_s", "mape_percent", "mvgpr", 16.43),
        ("k_p", "rmse", "linear", 0.1953),
        ("c_s", "rmse", "msvr", 0.0739),
    ],
)
def test_published_figures_are_those_of_table_vi(output, metric, model, value):
    assert PUBLISHED[output, metric][model] == value


def test_records_have_exactly_the_agreed_keys_and_order(records):
    assert len(records) == 4 * 2 * 2
    assert all(list(record) == KEYS for record in records)
    order = [(r["output"], r["metric"], r["model"]) for r in records]
    assert order == [
        (output, metric, model)
        for output in ("k_p", "c_p", "k_s", "c_s")
        for metric in ("mape_percent", "rmse")
        for model in ("msvr", "linear")
    ]


def test_records_hold_the_figures_of_their_run(records):
    chosen = next(
        r for r in records if (r["output"], r["metric"], r["model"]) == ("c_p", "rmse", "linear")
    )
    assert chosen == {
        "protocol": "multi_location",
        "group": "primary",
        "output": "c_p",
        "metric": "rmse",
        "model": "linear",
        "published": 0.2151,
        "measured": 0.07,
        "bound": 0.0015,
        "n_train": 20_000,
        "snr_db": 34.0,
        "seed": 3,
        "seconds": 0.25,
    }


# round trips


def cells(markdown):
    """Return the rows of a Markdown table, header first."""
    lines = [line for line in markdown.splitlines() if not set(line) <= set("|-: ")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_markdown_holds_every_record(records):
    header, *rows = cells(table6_markdown(records))
    assert header == [
        "group",
        "output",
        "metric",
        "MSVR paper",
        "MSVR ours",
        "MV-LR paper",
        "MV-LR ours",
        "bound",
    ]
    assert len(rows) == 8
    by_key = {(row[1], row[2]): row for row in rows}
    column = {"msvr": 3, "linear": 5}
    for record in records:
        metric = "MAPE %" if record["metric"] == "mape_percent" else "RMSE"
        row = by_key[record["output"], metric]
        first = column[record["model"]]
        assert row[0] == record["group"]
        # three digits are printed
        assert float(row[first]) == pytest.approx(record["published"], rel=6e-3)
        assert float(row[first + 1]) == pytest.approx(record["measured"], rel=6e-3)
        assert float(row[-1]) == pytest.approx(record["bound"], rel=6e-3)


def test_markdown_marks_what_is_absent():
    markdown = table6_markdown(
        table6_records([run("msvr", ("k_p",)), run("curve_fit", ("k_p", "c_p"))])
    )
    _, *rows = cells(markdown)
    by_key = {(row[1], row[2]): row[3:] for row in rows}
    assert by_key["k_p", "MAPE %"] == ["5.89", "1.50", "-", "1.75", "0.125"]
    assert by_key["c_p", "MAPE %"] == ["-", "-", "-", "2.75", "1.12"]


def test_csv_holds_every_record(records):
    found = list(csv.DictReader(io.StringIO(records_csv(records))))
    assert [list(row) for row in found] == [KEYS] * len(records)
    assert found == [{key: str(value) for key, value in r.items()} for r in records]
    assert [float(row["measured"]) for row in found] == [r["measured"] for r in records]


SCORES = ["output", "MAPE %", "bound", "RMSE", "bound", "bound sd %", "rms / bound"]


def scored(**changes):
    bounds = {"cramer_rao_percent": {"k_p": 0.157, "c_p": math.inf}}
    ratios = {"rms_ratio": {"k_p": 1.0249, "c_p": math.nan}}
    return run("msvr", ("k_p", "c_p")) | bounds | ratios | changes


def test_tables_on_a_terminal_fit_100_columns(records):
    outputs = {name: {"coverage_percent": 90.25, "half_width_percent": 12.34} for name in ("k_p",)}
    wide = scored(intervals={"level": 0.9, "outputs": outputs}) | {
        "scores": run("msvr", ["k_p"])["scores"]
    }
    assert max(map(len, scores_table(wide).splitlines())) <= 100
    printed = table6_short(records)
    assert max(map(len, printed.splitlines())) <= 100
    header, *rows = cells(printed)
    assert header[0] == "MAPE %, ours (the paper's)"
    assert rows[0][0] == "MSVR"
    assert rows[0][1].endswith("(5.89)")
    assert rows[-1][0] == "bound"


def test_scores_table_puts_each_score_beside_its_bound():
    header, *rows = cells(scores_table(scored()))
    assert header == SCORES
    assert rows == [
        ["k_p", "1.50", "0.125", "0.01", "0.0005", "0.157", "1.02"],
        ["c_p", "2.50", "1.12", "0.02", "0.0015", "-", "-"],
    ]


def test_scores_table_of_a_calibrated_model_has_its_intervals():
    outputs = {
        "k_p": {"coverage_percent": 90.25, "half_width_percent": 0.314},
        "c_p": {"coverage_percent": 100.0, "half_width_percent": 12.34},
    }
    header, *rows = cells(scores_table(scored(intervals={"level": 0.9, "outputs": outputs})))
    assert header == [*SCORES, "90 % +-", "covers %"]
    assert [row[:7] for row in rows] == cells(scores_table(scored()))[1:]
    assert [row[7:] for row in rows] == [["0.314", "90.25"], ["12.34", "100"]]
