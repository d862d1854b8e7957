"""Bounds, directions and options against naive oracles; the report and its place in evaluate.py."""

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reference
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from hydra.errors import ConfigCompositionException
from matplotlib.backends.backend_agg import FigureCanvasAgg
from omegaconf import open_dict
from trips_reference import pitching_numbers, pitching_transfer
from vehicles import AM96

from suspnet.bounds.identifiability import (
    ONE_SIDE,
    PAIR,
    SECOND_SET,
    Bound,
    Direction,
    Option,
    bounds,
    directions,
    listed,
    options,
    with_healthy,
)
from suspnet.bounds.information import cramer_rao, fisher_information, scale_ambiguity_bound
from suspnet.bounds.sensor_information import recording_information
from suspnet.cli import evaluate
from suspnet.curves.curves import CurveSettings
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.problem import TEST
from suspnet.curves.protocols import RESPONSES
from suspnet.runs.identifiability import (
    best_addition_sentence,
    group_markdown,
    identifiability_figure,
    identify,
)
from suspnet.vehicle import PARAMETERS, QuarterCar, VerticalVehicle

ROOT = Path(__file__).parents[2]
CURVES = CurveSettings(cache_dir=None)
COARSE = CurveSettings(step_hz=0.1, cache_dir=None)
TRIP = EstimateSettings(minutes=10.0, segment_s=10.0, cache_dir=None).bound(AM96)
QUARTER_CAR, PITCHING = QuarterCar(AM96), VerticalVehicle(AM96)
RATIOS = with_healthy(np.array([[0.8, 1.3, 1.2, 0.9, 1.1], [1.5, 0.7, 0.6, 1.8, 0.9]]))
HEALTHY = np.ones(5)


def direction(components, deviation=1.0):
    """Return a direction of as many of the five parameters as there are components."""
    names = PARAMETERS[: len(components)]
    return Direction(names, np.array(components) / np.linalg.norm(components), deviation)


def option(information, unknown, title="only G_p", kind="baseline"):
    return Option(title, kind, unknown, np.asarray(information, dtype=float))


def row(kind, title, **medians):
    """Return an option without information and bounds of given medians."""
    found = [Bound(name, m, (m, m, m, m, m)) for name, m in medians.items()]
    return option(np.zeros((1, 0, 0)), tuple(medians), title, kind), found


def log_jacobian(ratios, responses, step=1e-5):
    """Return the derivative of chosen curves over their noise by the logarithm of each ratio."""
    frequencies = CURVES.frequencies_hz().numpy()
    curves = reference.magnitudes(AM96, ratios, frequencies)
    rms = np.sqrt((curves**2).mean(axis=1, keepdims=True)) * 10 ** (-34 / 20)
    columns = []
    for j in range(5):
        up, down = ratios.copy(), ratios.copy()
        up[j] *= math.exp(step)
        down[j] *= math.exp(-step)
        change = [reference.magnitudes(AM96, x, frequencies) for x in (up, down)]
        columns.append(((change[0] - change[1]) / (2 * step) / rms)[responses].ravel())
    return np.array(columns).T


def found_by_title(task, observer, ratios=RATIOS):
    return {found.title: found for found in options(task, observer, ratios)}


# bounds: reference


def test_bounds_are_those_of_least_squares_on_logarithms(task, quarter_car):
    """Singular values of the curves' derivative by the logarithms, each vehicle by itself."""
    now, *_ = options(task("joint", "all"), CURVES.observer(quarter_car), RATIOS)
    percent = now.percent(RATIOS)
    for ratios, found in zip(RATIOS, percent, strict=True):
        inverse = np.linalg.pinv(log_jacobian(ratios, [0, 1]))
        expected = 100 * np.sqrt((inverse**2).sum(axis=1))
        assert (expected > 0.01).all()
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_bounds_are_sorted_over_the_range_and_healthy_apart():
    sizes = np.random.default_rng(0).permutation(np.arange(1, 101))
    information = np.concatenate([[[[1e-8]]], 1.0 / sizes[:, None, None].astype(float) ** 2])
    ratios = np.ones((101, 5))
    ratios[1:, 2] = 2.0
    (found,) = bounds(option(information, ("k_s",)), ratios)
    assert found.parameter == "k_s"
    assert found.healthy_percent == pytest.approx(1e6)
    # 50 % times 1 to 100
    assert found.percentiles == pytest.approx((250, 1250, 2500, 3750, 4750))
    assert (found.median_percent, found.p95_percent) == pytest.approx((2500, 4750))


def test_bounds_stay_infinite_where_some_vehicles_are():
    information = np.array([[[1.0]]] * 12 + [[[0.0]]] * 8)
    (found,) = bounds(option(information, ("k_p",)), np.ones((20, 5)))
    assert found.median_percent == 100
    assert math.isinf(found.p95_percent)


@pytest.mark.parametrize(
    ("p95", "expected"),
    [
        *((0.0, "well"), (1.0, "well"), (1.01, "fairly"), (5.0, "fairly")),
        *((5.1, "poorly"), (20.0, "poorly"), (20.1, "not"), (math.inf, "not")),
    ],
)
def test_verdict_is_that_of_the_95th_percentile(p95, expected):
    assert Bound("k_p", 0.0, (0.0, 0.0, 0.0, 0.0, p95)).verdict == expected


# directions: reference


def test_g_s_alone_leaves_k_s_c_s_and_the_mass_moving_together(task, quarter_car):
    now = options(task("own_curve", "secondary"), CURVES.observer(quarter_car), RATIOS)[0]
    assert now.unknown == ("k_s", "c_s", "M_s")
    first, *others = directions(now.information[0], now.unknown)
    assert math.isinf(first.deviation_percent)
    # all scaled alike leaves G_s unchanged
    np.testing.assert_allclose(first.components, np.full(3, 3**-0.5), atol=1e-6)
    assert first.words() == "k_s, c_s and M_s move together"
    assert all(math.isfinite(other.deviation_percent) for other in others)


def test_directions_of_both_curves_are_singular_vectors(task, quarter_car):
    now = options(task("joint", "all"), CURVES.observer(quarter_car), RATIOS)[0]
    found = directions(now.information[0], now.unknown)
    _, values, vectors = np.linalg.svd(log_jacobian(HEALTHY, [0, 1]), full_matrices=False)
    for direction, value, vector in zip(found, values[::-1], vectors[::-1], strict=True):
        assert direction.deviation_percent == pytest.approx(100 / value, rel=1e-6)
        sign = np.sign(vector[np.abs(vector).argmax()])
        np.testing.assert_allclose(direction.components, sign * vector, atol=1e-5)
    assert found[0].words() == "c_p moves alone"
    assert found[1].words() == "k_p, k_s, c_s and M_s move together"


def test_squares_of_changes_add_up_to_the_bounds(task, quarter_car):
    now = options(task("joint", "all"), CURVES.observer(quarter_car), RATIOS)[0]
    found = directions(now.information[0], now.unknown)
    for name, least in zip(now.unknown, now.percent(RATIOS)[0], strict=True):
        assert math.hypot(*(d.changes_percent[name] for d in found)) == pytest.approx(least)


def test_parameter_that_is_not_seen_is_a_direction_of_its_own():
    information = np.zeros((3, 3))
    information[np.ix_([0, 2], [0, 2])] = [[4.0, 1.0], [1.0, 4.0]]
    unseen, weak, strong = directions(information, ("k_p", "c_p", "k_s"))
    assert (unseen.words(), unseen.deviation_percent) == ("c_p moves alone", math.inf)
    assert weak.words() == "k_p and k_s move against each other"
    assert weak.deviation_percent == pytest.approx(100 / math.sqrt(3))
    assert strong.deviation_percent == pytest.approx(100 / math.sqrt(5))


@pytest.mark.parametrize(("eigenvalue", "seen"), [(1e-9, True), (1e-14, False), (-1e-18, False)])
def test_direction_within_rounding_of_nothing_is_not_seen(eigenvalue, seen):
    rotation = np.array([[0.6, 0.8], [-0.8, 0.6]])
    information = 1e6 * rotation @ np.diag([1.0, eigenvalue]) @ rotation.T
    weakest, strongest = directions(information, ("k_p", "c_p"))
    assert math.isfinite(weakest.deviation_percent) == seen
    assert weakest.components == pytest.approx([0.8, 0.6])
    assert strongest.deviation_percent == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("components", "words"),
    [
        ([1, 0, 0], "k_p moves alone"),
        ([0.29, 1, -0.29], "c_p moves alone"),
        ([0.31, 1, 0], "k_p and c_p move together"),
        ([1, -0.5], "k_p and c_p move against each other"),
        ([1, 0.5, 0.9], "k_p, c_p and k_s move together"),
        ([-0.4, 1, 0.5], "c_p and k_s move together against k_p"),
        ([-0.4, -0.5, 1], "k_s moves against k_p and c_p"),
    ],
)
def test_words_name_what_takes_part(components, words):
    assert direction(components).words() == words


def test_changes_are_components_times_the_deviation():
    found = direction([3.0, -4.0], deviation=2.0)
    assert found.changes_percent == pytest.approx({"k_p": 1.2, "c_p": -1.6})


# options of curves: reference


def test_options_of_curves_are_their_parts(task, quarter_car):
    joint, observer = task("joint", "all"), CURVES.observer(quarter_car)
    found = found_by_title(joint, observer)
    assert [option.kind for option in found.values()] == [
        "baseline",
        "less",
        "less",
        "more",
        "more",
    ]

    def fisher(parameters=PARAMETERS, responses=("G_p", "G_s"), snr_db=34.0):
        source = replace(CURVES, snr_db=snr_db).observer(quarter_car)
        return fisher_information(source, RATIOS, parameters, responses)

    for title, responses in (("only G_p", ("G_p",)), ("only G_s", ("G_s",))):
        np.testing.assert_allclose(found[title].information, fisher(responses=responses))
    np.testing.assert_allclose(found["both curves"].information, fisher(), rtol=1e-9, atol=1e-3)
    twice = cramer_rao(fisher(snr_db=34 + 10 * math.log10(2)))
    np.testing.assert_allclose(
        found["+ a second set of sensors"].percent(RATIOS), 100 * twice / RATIOS, rtol=1e-6
    )
    known = found["+ measured car-body mass"]
    assert known.unknown == PARAMETERS[:4]
    expected = 100 * cramer_rao(fisher(PARAMETERS[:4])) / RATIOS[:, :4]
    np.testing.assert_allclose(known.percent(RATIOS), expected, rtol=1e-6)


def test_more_is_what_needs_another_curve(task, quarter_car):
    found = found_by_title(task("own_curve", "primary"), CURVES.observer(quarter_car))
    kinds = {title: option.kind for title, option in found.items()}
    assert kinds["only G_p"] == "baseline"
    assert next(iter(kinds)) == "only G_p"
    assert (kinds["only G_s"], kinds["both curves"]) == ("other", "more")


def test_further_sensors_add_the_magnitudes_from_the_axle_box(task):
    coarse, ratios = COARSE.observer(PITCHING), RATIOS[1:2]
    found = found_by_title(task("joint", "all"), coarse, ratios)
    frequencies = coarse.frequencies_hz.numpy()
    behind = -2 * AM96.half_pivot_distance_m

    def curves(x):
        numbers = pitching_numbers(AM96, x, 70.0)
        both = [
            pitching_transfer(numbers, f, frame_sensor="centre", body_sensor_m=behind)
            for f in frequencies
        ]
        frame, body = np.array(both).T
        return np.abs([frame, frame * body])

    clean, step, slopes = curves(ratios[0]), 1e-5, []
    for j in range(5):
        up, down = ratios[0].copy(), ratios[0].copy()
        up[j] += step
        down[j] -= step
        slopes.append((curves(up) - curves(down)) / (2 * step))
    rms = np.sqrt((clean**2).mean(axis=1, keepdims=True)) * 10 ** (-34 / 20)
    jacobian = np.array(slopes) / rms  # (5, 2, n_freq)
    for k, title in enumerate(("+ frame centre", "+ body above the other bogie")):
        added = (found[title].information - found["both curves"].information)[0]
        expected = jacobian[:, k] @ jacobian[:, k].T
        size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        np.testing.assert_allclose(added / size, expected / size, atol=1e-5)
        assert found[title].kind == "more"


def test_measured_mass_becomes_the_baseline(task, quarter_car):
    known = task("own_curve", "secondary", mass_known=True)
    first, *_, last = options(known, CURVES.observer(quarter_car), RATIOS)
    assert first.unknown == ("k_s", "c_s")
    assert np.isfinite(first.percent(RATIOS)).all()
    assert (last.title, last.kind) == ("car-body mass not measured", "less")
    assert last.unknown == ("k_s", "c_s", "M_s")
    assert np.isinf(last.percent(RATIOS)).all()


def test_uncertain_numbers_count_once_however_many_curves_tell_of_them(task):
    deviations = {"half_wheelbase": 0.1, "body_gyration": 0.3}
    observer = COARSE.observer(VerticalVehicle(AM96, distribution=deviations))
    ratios = RATIOS[1:2]
    found = found_by_title(task("joint", "all"), observer, ratios)
    both = fisher_information(observer, ratios)
    np.testing.assert_allclose(found["both curves"].information, both, rtol=1e-9)
    alone = sum(found[f"only {name}"].information for name in RESPONSES)
    twice = found["+ " + SECOND_SET].information
    certain = fisher_information(COARSE.observer(VerticalVehicle(AM96)), ratios)
    most = np.linalg.eigvalsh(both)[0, -1]
    # both curves tell more of the numbers than each alone; twice the curves are no second vehicle
    assert np.linalg.eigvalsh(both - alone)[0, -1] > 0.1 * most
    assert np.linalg.eigvalsh(2 * both - twice)[0, -1] > 1e-6 * most
    assert np.linalg.eigvalsh(certain - both)[0, -1] > 1e-6 * most


# options of trips


def test_options_of_trips_are_sensors_and_the_estimate(task):
    joint, observer = task("joint", "all"), TRIP.observer(PITCHING)
    found = found_by_title(joint, observer)
    kinds = {title: option.kind for title, option in found.items()}
    assert kinds == {
        "three sensors": "baseline",
        "without the axle box": "less",
        "without the bogie": "less",
        "without the body": "less",
        "+ frame centre": "more",
        "+ body above the other bogie": "more",
        "+ second axle box": "more",
        "+ a second set of sensors": "more",
        "three sensors, IV estimate": "estimate",
        "+ measured car-body mass": "more",
    }
    estimate = fisher_information(observer, RATIOS, PARAMETERS)
    np.testing.assert_allclose(found["three sensors, IV estimate"].information, estimate)
    places = np.eye(6)
    counts = [[0, 1, 1, 0, 0, 0], *(places[:3].sum(axis=0) + places[3:])]
    chosen = recording_information(observer, RATIOS, PARAMETERS, counts)
    further = list(kinds)[4:7]
    for title, information in zip(["without the axle box", *further], chosen, strict=True):
        np.testing.assert_array_equal(found[title].information, information)
    three = found["three sensors"].percent(RATIOS)
    for title, option in found.items():
        change = option.percent(RATIOS) / three[:, : len(option.unknown)]
        if kinds[title] == "more":
            assert (change < 1).all()
        elif kinds[title] != "baseline":
            assert (change > 1).all()


def test_quarter_car_has_no_further_places(task):
    joint = task("joint", "all")
    found = found_by_title(joint, TRIP.observer(QUARTER_CAR))
    more = [title for title, option in found.items() if option.kind == "more"]
    assert more == ["+ a second set of sensors", "+ measured car-body mass"]
    assert np.isinf(found["without the axle box"].percent(RATIOS)).all()


def test_pairs_and_one_side_are_options_where_the_vehicle_rolls(task):
    joint, short = task("joint", "all"), replace(TRIP, low_hz=0.8, high_hz=1.2)
    deviations = {"cross_level": 0.7, "anti_roll_bar": 1.0, "body_lateral": 0.1}
    rolling = {"parts": ("roll",), "distribution": deviations}
    middle = VerticalVehicle(AM96, **rolling)
    off = VerticalVehicle(AM96, sensor_lateral_m=(1.0, 1.0, 1.0), **rolling)
    ratios = RATIOS[1:2]
    in_middle, one_sided = (found_by_title(joint, short.observer(g), ratios) for g in (middle, off))
    pair, second, side = in_middle[PAIR], in_middle["+ " + SECOND_SET], in_middle[ONE_SIDE]
    assert (pair.kind, side.kind, one_sided[PAIR].kind) == ("more", "less", "more")
    np.testing.assert_allclose(pair.information, second.information, rtol=1e-9)
    np.testing.assert_allclose(one_sided[PAIR].information, pair.information, rtol=1e-9)
    now = one_sided["three sensors"]
    np.testing.assert_allclose(side.information, now.information, rtol=1e-9)
    assert ONE_SIDE not in one_sided
    # uncertain roll and cross level cost more than the second sensor's noise
    assert (pair.percent(ratios) < now.percent(ratios)).all()


# sentences


def test_sentence_names_the_addition_that_helps_most():
    table = [
        row("baseline", "only G_s", k_p=1.0, c_p=1.0, k_s=math.inf),
        row("more", "both curves", k_p=0.95, c_p=0.5, k_s=0.2),
        row("more", "+ measured car-body mass", k_p=0.92, c_p=0.7, k_s=0.3),
        row("estimate", "estimate", k_p=0.1, c_p=0.1, k_s=0.1),
    ]
    assert best_addition_sentence(table) == (
        "What lowers each bound most: k_p, nothing listed; c_p, both curves (1 to 0.5 %); "
        "k_s, both curves (not identified to 0.2 %)."
    )


def test_list_in_words():
    assert [listed(list(names)) for names in ("a", "ab", "abc")] == ["a", "a and b", "a, b and c"]


# report


def test_findings_give_absolute_bounds_of_the_healthy_vehicle(task, quarter_car):
    found = identify(quarter_car, task("joint", "all"), COARSE, 20, seed=0)
    bound = next(bound for bound in found.bounds_now if bound.parameter == "k_s")
    information = fisher_information(COARSE.observer(quarter_car), HEALTHY[None])
    least = 0.69e6 * cramer_rao(information)[0, PARAMETERS.index("k_s")]
    assert found.bound_at_healthy(bound) == pytest.approx(least, rel=1e-6)
    weakest = directions(information[0], PARAMETERS)[0]
    assert found.directions[0].deviation_percent == pytest.approx(weakest.deviation_percent)
    assert least > 1000
    row = rf"\| 690,000 N/m +\| {round(least, -1):,.0f} N/m +\|"
    assert re.search(row, group_markdown(found))
    assert "k_p and c_p stay healthy" in group_markdown(
        identify(quarter_car, task("own_curve", "secondary"), COARSE, 20, seed=0)
    )


def test_best_guess_is_that_of_the_ambiguity(task, quarter_car):
    secondary = task("own_curve", "secondary")
    found = identify(quarter_car, secondary, COARSE, 50, seed=0)
    limit = scale_ambiguity_bound(secondary, secondary.sample(50, 0, TEST))
    assert found.guess_percent == limit["k_s"]["mape_percent"]
    assert found.guess_percent > 10
    assert identify(quarter_car, task("joint", "all"), COARSE, 5, seed=0).guess_percent is None


def test_trips_are_judged_by_their_estimate(task):
    found = identify(QUARTER_CAR, task("joint", "all"), TRIP, 20, seed=0)
    assert found.now.kind == "estimate"
    table = dict((option.title, part) for option, part in found.table)
    assert found.bounds_now is table["three sensors, IV estimate"]
    assert "The estimate has 1." in group_markdown(found)


def test_figure_shows_bounds_and_options_of_each_group(task, quarter_car):
    groups = [
        identify(quarter_car, task("own_curve", g), COARSE, 20, 0) for g in ("primary", "secondary")
    ]
    figure = identifiability_figure(groups)
    FigureCanvasAgg(figure).draw()
    assert len(figure.axes) == 4
    left, right = figure.axes[2:]
    assert [text.get_text() for text in right.texts].count("not") == 6
    assert [text.get_text() for text in right.texts].count("known") == 1
    assert [label.get_text() for label in left.get_xticklabels()] == ["$k_s$", "$c_s$", "$M_s$"]
    assert right.get_yticklabels()[0].get_text() == "only $G_s$, as now"
    words = [text.get_text() for text in figure.axes[0].texts]
    medians = [float(word) for word in words if word[0].isdigit()]
    assert medians == [float(f"{bound.median_percent:.2g}") for bound in groups[0].bounds_now]


# the program


def run(folder, *overrides):
    """Run the study in this process; return what its JSON file holds."""
    with initialize_config_dir(version_base="1.3", config_dir=str(ROOT / "configs")):
        output = f"hydra.runtime.output_dir={folder}"
        overrides = ["study=identifiability", "n_vehicles=20", "threads=1", *overrides, output]
        config = compose("evaluate", overrides=overrides, return_hydra_config=True)
    HydraConfig.instance().set_config(config)
    with open_dict(config):
        del config["hydra"]
    folder.mkdir(parents=True, exist_ok=True)
    evaluate.main(config)
    return json.loads((folder / "identifiability.json").read_text())


def test_program_reports_every_group(tmp_path):
    own_curve = [
        "protocol=multi_location",
        "protocol.groups.primary.responses=[G_p]",
        "protocol.groups.primary.peaks=[primary_largest]",
        "protocol.groups.secondary.responses=[G_s]",
        "protocol.groups.secondary.peaks=[secondary]",
    ]
    found = run(tmp_path, "vehicle=ice3", *own_curve, "data.snr_db=26")
    assert list(found["groups"]) == ["primary", "secondary"]
    assert (found["vehicle"], found["settings"]["snr_db"]) == ("ice3", 26)
    assert found["groups"]["primary"]["bounds"]["k_p"]["healthy"] == 2.4e6
    assert found["groups"]["secondary"]["bounds"]["k_s"]["median_percent"] is None
    names = {path.name for path in tmp_path.iterdir()}
    assert {"config.yaml", *(f"identifiability.{end}" for end in ("md", "csv", "png"))} <= names
    assert any(name.startswith("events.out") for name in names)
    with (tmp_path / "identifiability.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 2 * (4 * 3 + 2)
    assert {row["median_percent"] for row in rows if row["option"] == "only G_s"} > {"inf"}
    text = (tmp_path / "identifiability.md").read_text()
    assert "## Group secondary: k_s and c_s" in text
    assert re.search(r"\| k_s, c_s and M_s move together +\| any +\| any +\| any", text)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["vehicle=sedan", "generator=vertical_vehicle"], "vehicle 'sedan' lacks"),
        (["data.snr_db=300"], "`data.snr_db` must be a finite number >= -20 and <= 200, got 300"),
        (["group=tertiary"], r"has no group 'tertiary'; choose from \['all'\]"),
        (["n_vehicles=0"], "`n_vehicles` must be a whole number >= 1, got 0"),
        (["seed=-1"], "`seed` must be a whole number >= 0, got -1"),
        (["protocol=paper", "n_vehicles=1000000"], "the grid of group 'I' holds"),
    ],
)
def test_mistake_gets_one_line(overrides, message, tmp_path):
    with pytest.raises(SystemExit, match=f"^error: .*{message}") as caught:
        run(tmp_path, *overrides)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("override", ["vehicle=ice3", "data=trips", "n_vehicles=5"])
def test_without_the_study_its_keys_are_unknown(override):
    directory = initialize_config_dir(version_base="1.3", config_dir=str(ROOT / "configs"))
    with directory, pytest.raises(ConfigCompositionException, match="Could not override"):
        compose("evaluate", overrides=["run=somewhere", override])
