"""Feature sets: continuous over the whole range, and absent where a peak is."""

import itertools
import math

import numpy as np
import pytest
import torch

from suspnet.curves.curves import add_noise
from suspnet.curves.extraction import PEAK_NAMES, PeakFeatures
from suspnet.curves.peaks import PeakReason, findpeaks
from suspnet.vehicle import PARAMETERS

GRID = 0.1 + 0.02 * torch.arange(996, dtype=torch.float64)
ALL = PeakFeatures(peaks=("secondary", "primary_lower", "primary_upper", "primary_largest"))
BY_PLACE, LARGEST = slice(0, 9), 9
SWEEP = torch.linspace(0.5, 2.0, 151, dtype=torch.float64)


def sweep(quarter_car, name):
    """Return the features of vehicles with one parameter from 0.50 to 2.00, the others healthy."""
    ratios = torch.ones(len(SWEEP), len(PARAMETERS), dtype=torch.float64)
    ratios[:, PARAMETERS.index(name)] = SWEEP
    return ALL.extract(quarter_car.magnitudes(ratios, GRID), GRID)


def largest_relative_jump(values):
    return (values.diff(dim=0) / values[:-1]).abs().amax(dim=0)


# reference


def test_features_of_the_healthy_vehicle_are_near_its_modes(quarter_car):
    table = ALL.extract(quarter_car.magnitudes(torch.ones(1, 5), GRID), GRID)
    values = dict(zip(ALL.names, table.values[0].tolist(), strict=True))
    assert table.reasons.tolist() == [[0, 0, 0, 0]]
    body_hz = quarter_car.vehicle.secondary_frequency_hz
    lower_hz, upper_hz = quarter_car.natural_modes()[0]
    # damping of 4 and 17 % moves the peaks off the undamped modes
    assert values["secondary_position"] == pytest.approx(body_hz, rel=0.1)
    assert values["primary_lower_position"] == pytest.approx(lower_hz, rel=0.1)
    assert values["primary_upper_position"] == pytest.approx(upper_hz, rel=0.1)
    assert values["primary_lower_position"] < values["secondary_position"]
    assert values["secondary_position"] < values["primary_upper_position"]


# property


@pytest.mark.parametrize("name", PARAMETERS)
def test_features_by_place_are_found_and_continuous(quarter_car, name):
    table = sweep(quarter_car, name)
    assert (table.reasons == PeakReason.FOUND).all()
    jumps = largest_relative_jump(table.values[:, BY_PLACE])
    # a step of 0.01 is 2 % of the smallest ratio; no feature is steeper than a second power
    assert jumps.max() < 0.04
    assert jumps.max() > 1e-4


@pytest.mark.parametrize("name", ["k_p", "k_s"])
def test_largest_primary_peak_jumps_between_the_resonances(quarter_car, name):
    position = sweep(quarter_car, name).values[:, LARGEST]
    jump = largest_relative_jump(position[:, None])
    assert jump > 0.5  # from one resonance to the other, 0.9-1.6 Hz to 4-7 Hz
    assert position.min() < 1.7
    assert position.max() > 4.0


def test_primary_group_has_every_feature_without_noise(task, quarter_car):
    problem = task("multi_location", "primary")
    corners = np.ones((8, 5))
    corners[:, [0, 1, 4]] = list(itertools.product((0.5, 2.0), repeat=3))
    ratios = np.concatenate([corners, problem.sample(1000, seed=0, stream=0)])
    curves = quarter_car.magnitudes(torch.as_tensor(ratios), GRID)
    table = problem.extractor.extract(curves, GRID)
    assert (table.reasons == PeakReason.FOUND).all()
    assert torch.isfinite(table.values).all()
    assert (table.values > 0).all()


def test_secondary_group_has_every_feature_unless_the_body_is_strongly_damped(task, quarter_car):
    problem = task("multi_location", "secondary")
    corners = np.ones((8, 5))
    corners[:, 2:] = list(itertools.product((0.5, 2.0), repeat=3))
    ratios = np.concatenate([corners, problem.sample(1500, seed=0, stream=0)])
    table = problem.extractor.extract(quarter_car.magnitudes(torch.as_tensor(ratios), GRID), GRID)
    healthy_damping = quarter_car.vehicle.secondary_damping_ratio
    damping = healthy_damping * ratios[:, 3] / np.sqrt(ratios[:, 2] * ratios[:, 4])
    found = table.reasons == PeakReason.FOUND
    lightly = torch.as_tensor(damping < 0.4)
    assert lightly.double().mean() > 0.9
    assert found[lightly].all()
    # above that the two peaks of abs(G_p) may melt into one, and the lost one says so
    assert found[:, 0].all()
    assert found.all(dim=1).double().mean() > 0.99
    assert torch.equal(table.values.isnan(), (~found).repeat_interleave(3, dim=1))


@pytest.mark.every_value
@pytest.mark.parametrize("shape", ["lorentzian", "gaussian"])
@pytest.mark.parametrize("size", [7, 128, pytest.param(1, marks=pytest.mark.slow)])
def test_features_do_not_depend_on_how_curves_are_batched(task, quarter_car, shape, size):
    ratios = torch.as_tensor(task("joint", "all").sample(200, seed=1, stream=0))
    curves = add_noise(quarter_car.magnitudes(ratios, GRID), 34.0, seed=0)
    extractor = PeakFeatures(PEAK_NAMES, shape)
    together = extractor.extract(curves, GRID)
    parts = [extractor.extract(part, GRID) for part in curves.split(size)]
    assert torch.equal(together.reasons, torch.cat([table.reasons for table in parts]))
    torch.testing.assert_close(
        together.values,
        torch.cat([table.values for table in parts]),
        rtol=1e-12,  # sums over bins begin where the windows of the batch do
        atol=0,
        equal_nan=True,
    )
    assert not torch.equal(together.values[0], together.values[1])


def test_largest_needs_no_secondary_curve(quarter_car):
    curves = quarter_car.magnitudes(torch.ones(1, 5), GRID)
    curves[:, 1] = math.nan
    table = PeakFeatures(peaks=("primary_largest",)).extract(curves, GRID)
    inside = (GRID >= 0.2) & (GRID <= 15.0)
    assert table.reasons.tolist() == [[PeakReason.FOUND]]
    top = GRID[inside][curves[0, 0, inside].argmax()].item()
    assert table.values[0, 0].item() == pytest.approx(top, abs=0.05)
    assert findpeaks(curves[:, 0, inside], GRID[inside]).valid.all()


# failure


@pytest.mark.parametrize(
    ("secondary", "reason"),
    [(1 / GRID, PeakReason.NO_MAXIMUM), (GRID * math.nan, PeakReason.NOT_FINITE)],
)
def test_without_a_secondary_peak_the_places_of_the_primary_ones_are_unknown(
    quarter_car, secondary, reason
):
    curves = quarter_car.magnitudes(torch.ones(2, 5), GRID)
    curves[0, 1] = secondary
    table = ALL.extract(curves, GRID)
    unknown = PeakReason.PLACE_UNKNOWN
    assert table.reasons.tolist() == [[reason, unknown, unknown, 0], [0, 0, 0, 0]]
    assert table.values[0].isnan().tolist() == [True] * 9 + [False] * 3
    assert torch.isfinite(table.values[1]).all()


def test_missing_peaks_are_named_with_their_reasons():
    features = PeakFeatures(peaks=("secondary", "primary_lower", "primary_upper"))
    assert features.missing(np.array([0, 0, 0])) == ""
    reasons = np.array([PeakReason.NO_MAXIMUM, 0, PeakReason.OUTSIDE_WINDOW])
    assert features.missing(reasons) == "secondary (no maximum), primary_upper (outside window)"


@pytest.mark.parametrize("shape", [(1, 2, 900), (1, 2, 1000), (2, 996), (1, 1, 996)])
def test_curves_of_the_wrong_shape_are_rejected(shape):
    with pytest.raises(ValueError, match=r"`curves` must have shape \(n_curves, 2, 996\)"):
        PeakFeatures().extract(torch.ones(shape), GRID)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ({"peaks": ()}, "`peaks` must be chosen from"),
        ({"peaks": ("secondary", "primary")}, "`peaks` must be chosen from"),
        ({"window": 0.0}, "`window` must be a finite number > 0"),
        ({"low_hz": 5.0, "high_hz": 1.0}, "need low_hz < high_hz"),
    ],
)
def test_settings_out_of_range_are_rejected(setting, message):
    with pytest.raises(ValueError, match=message):
        PeakFeatures(**setting)
