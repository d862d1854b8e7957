"""Every plot gives a Figure that can be drawn, with the right axes and finite data."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from suspnet.curves.extraction import PeakFeatures
from suspnet.runs import plots
from suspnet.runs.tables import table6_records

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
paper_figures = pytest.importorskip("paper_figures", reason="needs benchmarks")

FREQUENCIES = 0.1 + 0.05 * torch.arange(398, dtype=torch.float64)
NAMES = ("k_p", "c_p")


@pytest.fixture
def predictions():
    rng = np.random.default_rng(0)
    actual = rng.uniform(0.5, 2.0, (200, 2))
    return actual, actual * rng.normal(1.0, 0.05, (200, 2))


def run(model, outputs, snr_db=34.0):
    return {
        "protocol": "multi_location",
        "model": model,
        "scores": {name: {"mape_percent": 400 / snr_db**2, "rmse": 0.02} for name in outputs},
        "bound": {name: {"mape_percent": 100 / snr_db**2, "rmse": 0.01} for name in outputs},
        "n_train": 100,
        "snr_db": snr_db,
        "seed": 0,
        "seconds": 1.0,
    }


def line_data(figure):
    """Return the x and y values of every line of a figure."""
    return [
        np.asarray(line.get_xydata(), dtype=float) for axis in figure.axes for line in axis.lines
    ]


def assert_drawn(figure, n_axes):
    """Check the number of axes and that all data are finite; drawing must not warn."""
    assert isinstance(figure, Figure)
    assert len(figure.axes) == n_axes
    shown = [data for data in line_data(figure) if len(data)]
    assert shown
    assert all(np.isfinite(data).all() for data in shown)
    figure.set_layout_engine("none")  # which takes most of the time
    figure.set_dpi(20)
    FigureCanvasAgg(figure).draw()


def test_bode_shows_decibels_and_degrees_of_both_responses(quarter_car):
    figure = paper_figures.bode(quarter_car, FREQUENCIES)
    assert_drawn(figure, 4)
    magnitude_p, magnitude_s, phase_p, phase_s = (axis.lines[0].get_ydata() for axis in figure.axes)
    curves = quarter_car.magnitudes(torch.ones(1, 5), FREQUENCIES)[0].numpy()
    np.testing.assert_allclose(magnitude_p, 20 * np.log10(curves[0]), atol=1e-9)
    np.testing.assert_allclose(magnitude_s, 20 * np.log10(curves[1]), atol=1e-9)
    # one degree of freedom turns by less than 180 degrees, two by less than 360
    assert -180 < phase_s.min() < phase_s.max() < 0
    assert -360 < phase_p.min() < phase_p.max() < 0


def test_model_shows_its_parameters_in_si_units(quarter_car):
    figure = paper_figures.quarter_car(quarter_car.vehicle)
    assert_drawn(figure, 1)
    texts = " ".join(text.get_text().replace("\n", " ") for text in figure.axes[0].texts)
    for words in ("$k_p$ 1,300,000 N/m", "$c_s$ 22,600 N s/m", "bogie $M_p$ 1,725 kg"):
        assert words in texts


def test_degradation_shows_three_curves_of_each_parameter_and_response(quarter_car):
    figure = paper_figures.degradation(quarter_car, FREQUENCIES)
    assert_drawn(figure, 10)
    assert [len(axis.lines) for axis in figure.axes] == [3] * 10
    # neither k_p nor c_p changes G_s, everything else changes what it is plotted for
    for axis, changes in zip(
        figure.axes, [True] * 5 + [False, False, True, True, True], strict=True
    ):
        half, _, double = (line.get_ydata() for line in axis.lines)
        assert bool(np.abs(half - double).max() > 1e-3) == changes


def test_peak_fits_mark_each_peak_on_its_own_curve(quarter_car):
    extractor = PeakFeatures()
    curves = quarter_car.magnitudes(torch.ones(1, 5), FREQUENCIES)
    values = extractor.extract(curves, FREQUENCIES).values[0].tolist()
    features = dict(zip(extractor.names, values, strict=True))
    figures = [
        plots.peak_fit(FREQUENCIES.numpy(), curve, features, suspension)
        for suspension, curve in zip(plots.PEAKS, curves[0].numpy(), strict=True)
    ]
    for figure in figures:
        assert_drawn(figure, 1)
    primary, secondary = (figure.axes[0] for figure in figures)
    assert len(primary.lines) == 1 + 2 * 2
    assert len(secondary.lines) == 1 + 2
    marker, width = secondary.lines[1:]
    assert marker.get_xydata().tolist() == [
        [features["secondary_position"], features["secondary_height"]]
    ]
    left, right = width.get_xdata()
    assert right - left == pytest.approx(features["secondary_width"])
    assert width.get_ydata()[0] == pytest.approx(features["secondary_height"] / math.sqrt(2))


def test_parity_shows_predictions_against_actual_values(predictions):
    actual, predicted = predictions
    figure = plots.parity(actual[:, 1], predicted[:, 1], NAMES[1])
    assert_drawn(figure, 1)
    (axis,) = figure.axes
    np.testing.assert_array_equal(
        axis.lines[0].get_xydata(), np.column_stack([actual[:, 1], predicted[:, 1]])
    )
    # readable where TensorBoard shows a row of small images
    texts = [axis.title, axis.xaxis.label, axis.yaxis.label, *axis.get_xticklabels()]
    assert {text.get_size() >= plots.FONT_POINTS for text in texts} == {True}


def test_table6_has_a_bar_and_the_published_value_of_each_model_and_output():
    records = table6_records(
        [run(model, outputs) for model in ("msvr", "linear") for outputs in (NAMES, ("k_s", "c_s"))]
    )
    figure = plots.table6(records)
    assert_drawn(figure, 1)
    (axis,) = figure.axes
    assert [text.get_text() for text in axis.get_xticklabels()] == [
        f"${name}$" for name in ("k_p", "c_p", "k_s", "c_s")
    ]
    assert [bar.get_height() for bar in axis.patches if bar.get_height()] == pytest.approx(
        [400 / 34**2] * 8
    )
    values = [line.get_ydata()[0] for line in axis.lines if len(line.get_ydata())]
    assert values[3:6] == pytest.approx([8.97, 21.71, 100 / 34**2])  # c_p: paper's two, bound


def test_a_bound_that_is_infinite_is_not_drawn():
    unknown = {"bound": {"k_s": dict.fromkeys(("mape_percent", "rmse"))}}
    runs = [run("msvr", ("k_s",), snr) | unknown for snr in (54.0, 34.0)]
    (published,) = (data for data in line_data(plots.table6(table6_records(runs[:1]))) if len(data))
    assert published.tolist() == [[0, 4.37]]
    measured, bound, *_ = paper_figures.sensitivity(runs).axes[0].lines
    assert np.isnan(np.array(bound.get_ydata(), float)).all()
    assert np.isfinite(measured.get_ydata()).all()


def test_sensitivity_shows_each_model_against_the_precision():
    runs = [run(model, NAMES, snr) for model in ("msvr", "linear") for snr in (54.0, 34.0, 26.0)]
    figure = paper_figures.sensitivity(runs)
    assert_drawn(figure, 2)
    first, _, second, *_ = figure.axes[0].lines
    assert [first.get_label(), second.get_label()] == ["$k_p$", "$c_p$"]
    assert list(first.get_xdata()) == pytest.approx([5.01, 2.0, 0.2], rel=4e-3)
    assert list(first.get_ydata()) == pytest.approx([400 / s**2 for s in (26, 34, 54)])
