"""The page of commissioning says what the fit found, in SI units, and stands alone."""

import base64
import json
import math
import re
from dataclasses import asdict, replace
from html import unescape

import numpy as np
import pytest
import torch
from commissioned_example import (
    BINS,
    MASSES,
    N_AVERAGES,
    SPEEDS,
    UNCERTAIN,
    commissioned_example,
    trip,
)
from vehicles import AM96

from suspnet.estimation.commissioned_bogie import CommissionedBogie, HealthyScatter
from suspnet.estimation.suspension_law import SuspensionLaw
from suspnet.ground.findings import Finding
from suspnet.runs.language import speaking
from suspnet.trains.fits.bogie_fit import FURTHER_PARTS
from suspnet.trains.fits.explained_trips import explained_trips
from suspnet.trains.identification import commissioning_summary as words
from suspnet.trains.identification.bogie_trips import PARTS_OF_BOGIE
from suspnet.trains.pages.commissioning_page import (
    amplified,
    as_json,
    links,
    training_notes,
    write_outcome,
)
from suspnet.vehicle import SpatialVehicle
from suspnet.vehicle.quantities import QUANTITIES, SPATIAL_QUANTITIES

HOSTILE = "<script>alert('x')</script> & \"$x_\" \udcff"


@pytest.fixture(scope="module")
def commissioned():
    return commissioned_example()


@pytest.fixture(scope="module")
def written(commissioned, tmp_path_factory):
    """Return the folder that the outcome was written to, its page and its JSON."""
    folder = tmp_path_factory.mktemp("run")
    write_outcome(folder, *commissioned)
    page = (folder / "commissioning.html").read_text(encoding="utf-8")
    return folder, page, json.loads((folder / "commissioning.json").read_text())


def test_all_numbers_that_a_page_may_show_have_a_heading():
    added = [q for q in SPATIAL_QUANTITIES if q.part in FURTHER_PARTS and q.deviation]
    assert {q.part for q in (*QUANTITIES, *added)} <= set(words.PART_TITLES)


def text_of(page):
    """Return the text of a page without tags, with plain spaces."""
    body = re.sub(r"<style>.*?</style>", "", page, flags=re.DOTALL)
    return " ".join(
        unescape(re.sub(r"<[^>]*>", " ", body)).replace("\N{NO-BREAK SPACE}", " ").split()
    )


# reference


def test_page_is_german_where_it_is_asked_for(commissioned, tmp_path, blank):
    with speaking("de"):
        write_outcome(tmp_path, *commissioned)
    text = text_of((tmp_path / "commissioning.html").read_text(encoding="utf-8"))
    for said in (
        "Inbetriebnahme von am96",
        "1,02-Fache des Rauschens",
        "Gesunde primäre Steifigkeit",
        "Buchsen der Dämpfer",
        "Gemessene und in Betrieb genommene Frequenzgänge",
    ):
        assert said in text
    assert not re.search(r"\b(the|of|is|are)\b", text.partition("trip_9")[0])


def test_numbers_in_json_are_those_of_the_outcome_in_si_units(commissioned, written):
    outcome, content = commissioned[1], written[2]
    by_name = {one["name"]: one for one in content["numbers"]}
    assert set(by_name) == set(UNCERTAIN)
    for i, name in enumerate(outcome.posterior.names):
        one = by_name[name]
        mean, deviation = outcome.posterior.mean[i], outcome.posterior.deviations[i]
        assert one["posterior"]["median"] == pytest.approx(one["nominal"] * math.exp(mean))
        for end, n in (("low", -1), ("high", 1)):
            value = one["nominal"] * math.exp(mean + n * deviation)
            assert one["posterior"][end] == pytest.approx(value)
            value = one["nominal"] * math.exp(n * UNCERTAIN[name])
            assert one["prior"][end] == pytest.approx(value)
        assert one["posterior"]["log_deviation"] == pytest.approx(deviation)
        assert one["prior"]["log_deviation"] == pytest.approx(UNCERTAIN[name])
        assert one["ratio"] == pytest.approx(math.exp(mean))
        assert one["uncertainty_left"] == pytest.approx(deviation / UNCERTAIN[name])
    assert by_name["healthy_k_p"]["nominal"] == 1.3e6
    assert by_name["healthy_k_p"]["unit"] == "N/m"
    assert by_name["healthy_k_p"]["posterior"]["median"] == pytest.approx(1.15 * 1.3e6, rel=0.02)
    assert by_name["primary_bushing"]["posterior"]["median"] == pytest.approx(3e6, rel=0.5)


def test_json_holds_trips_masses_and_misfits(commissioned, written):
    outcome, content = commissioned[1], written[2]
    assert content["misfit"] == outcome.bogie.misfit == 1.02
    assert content["explained"] is True
    assert content["mileage_km"] == [12345.0, 37035.0]
    assert content["left_out"] == ["trip_9: no stretch at one speed"]
    for one, mass, speed in zip(content["trips"], MASSES, SPEEDS, strict=True):
        assert one["mass_ratio"] == mass
        assert one["mass_kg"] == pytest.approx(6300.0 * mass)
        assert one["centre_m"] == []
        assert one["speed_m_per_s"] == speed
        assert one["n_averages"] == N_AVERAGES
        # the trips were drawn with the numbers of the bogie
        assert one["misfit"] == pytest.approx(1, abs=0.1)


def test_responses_are_those_of_the_mean_of_both_sides(commissioned):
    found, outcome = commissioned
    trip = found.of_parts[0]
    ends = links(found.vehicle.sensors)
    means = np.kron(np.eye(3), [0.5, 0.5])
    for i, both in enumerate(ends.values()):
        np.testing.assert_array_equal(both, means[i : i + 2])
        magnitudes, deviations = amplified(trip.spectra, both)
        for matrix, magnitude, deviation in zip(
            trip.spectra.values.numpy(), magnitudes, deviations, strict=True
        ):
            lower, upper = both
            power = [(end @ matrix @ end).real for end in (lower, upper)]
            cross = abs(upper @ matrix @ lower)
            assert magnitude == pytest.approx(cross / power[0])
            square = cross**2 / power[0] / power[1]
            expected = math.sqrt(max(0.0, 1 - square) / (2 * N_AVERAGES * square))
            assert deviation == pytest.approx(expected, rel=1e-6)
    # the bogie's vehicle is as far from its trip as noise, that of the drawing far off
    off = {}
    for vehicle in (outcome.bogie.generator, found.vehicle):
        (one, *_) = explained_trips(vehicle, outcome.bogie, found.of_parts, [None] * 3)
        logs = [
            np.log(amplified(one.expected, both)[0] / amplified(trip.spectra, both)[0])
            for both in ends.values()
        ]
        off[vehicle] = np.sqrt(np.mean(np.square(logs)))
    fitted, drawing = off.values()
    assert fitted < 0.1 * drawing


def test_sensors_of_one_end_alone_show_no_suspension():
    sensors = "frame_axle1_left", "frame_axle1_right", "frame_axle2_left", "body_middle"
    ((_, both),) = links(sensors).items()
    np.testing.assert_array_equal(both, [[0.5, 0.5, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def test_page_holds_the_law_of_damping_over_temperature(commissioned):
    found, outcome = commissioned
    deviations = 0.002, 0.0003, 0.05, 0.1, 0.01, 0.01, 0.2
    covariance = tuple(map(tuple, np.diag(np.square(deviations)).tolist()))
    law = SuspensionLaw(12.0, (0.1, 0.2), (-0.004, -0.0051, -0.3, 0.1, 0, 0, -1), covariance)
    warm = replace(outcome, bogie=replace(outcome.bogie, law=law))
    written = json.loads(json.dumps(as_json(found, warm, [1.0] * len(found.of_parts))))
    assert written["suspension_law"] == json.loads(json.dumps(asdict(law)))
    assert "suspension_law" not in as_json(found, outcome, [1.0] * len(found.of_parts))
    text = " ".join(words.reference(warm))
    assert text.endswith(
        "Damping is compared at 12 °C, their mean temperature; per kelvin c_p 0.40 ± 0.2 % and "
        "c_s 0.51 ± 0.03 % are lost. Damping is compared at the speed of the dampers on the "
        "healthy trips; where they move 10 % faster, c_p 3.00 ± 0.5 % and c_s -1.00 ± 1 % are lost."
    )


# properties


def test_page_says_what_was_found(commissioned, written):
    text = text_of(written[1])
    assert "Each part of the bogie is read: its misfit is 1.02 times the noise" in text
    assert "Healthy now means what these trips showed: 100 % is k p = 1." in text
    assert "12 345 to 37 035 km" in text
    assert "trip_9: no stretch at one speed" in text
    assert "The trips do not determine 1 of 6 numbers" in text
    assert "density of half the cross level over the mean's" in text
    assert "1725 kg for a bogie's side" in text
    for title in ("Springs, dampers, lengths and inertias", "Bushings of the dampers"):
        assert title in text
    assert 'class="result good"' in written[1]
    for one in words.numbers(commissioned[1]):
        row = words.cells(one)
        assert row["prior"] in text
        assert row["posterior"] in text


def test_page_stands_alone_and_holds_no_nan(written):
    folder, page, content = written
    assert not re.search(r"\bnan\b|\binf\b|None", text_of(page), flags=re.IGNORECASE)
    assert "null" not in json.dumps(content)
    images = re.findall(r'<img src="data:image/(?:svg\+xml|png);base64,([^"]*)"', page)
    assert len(images) == page.count("<img") == 1
    assert all(len(base64.b64decode(one, validate=True)) > 1000 for one in images)
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    names = {path.name for path in (folder / "figures").iterdir()}
    assert names == {"commissioning_responses.png"}
    assert all((folder / "figures" / name).read_bytes()[1:4] == b"PNG" for name in names)


def test_names_are_escaped(commissioned, tmp_path, blank):
    found, outcome = commissioned
    manifests = tuple(trip(HOSTILE, float(i), suspension=HOSTILE) for i in range(3))
    hostile = replace(found, manifests=manifests, paired=(False,) * 3, left_out=(HOSTILE,))
    write_outcome(tmp_path, hostile, outcome)
    page = (tmp_path / "commissioning.html").read_text(encoding="utf-8")
    assert "<script" not in page
    assert page.count("&lt;script&gt;") == 5  # the suspension, three trips, one left out


def test_notes_for_the_model_file_name_the_trips(commissioned):
    notes = training_notes(*commissioned)
    assert notes == {
        "n_trips": 3,
        "misfit": 1.02,
        "explained": True,
        "converged": True,
        "mileage_km": [12345.0, 37035.0],
        "trips": ["trip_0", "trip_1", "trip_2"],
        "place": {"suspension": "S1", "bogie": "", "side": "", "train": "", "car": ""},
    }
    json.dumps(notes)


def bogie(misfit, converged=True):
    """Return a bogie of which one damper of twelve is 12 % above its kind, with errors."""
    errors = torch.full((len(BINS), 6), 0.02, dtype=torch.float64)
    errors[4, 3] = 0.4
    vehicle = SpatialVehicle(AM96, parts=(*PARTS_OF_BOGIE, "track", "load"), distribution="prior")
    mean = list(vehicle.distribution.mean)
    mean[vehicle.distribution.names.index("healthy_c_p_axle2_left")] = math.log(1.16)
    vehicle = replace(vehicle, distribution=replace(vehicle.distribution, mean=tuple(mean)))
    return CommissionedBogie(
        vehicle,
        torch.ones(6, dtype=torch.float64),
        np.ones(3),
        misfit,
        converged,
        HealthyScatter((1e-3,) * 4, (0.0,) * 4, 5, tuple(map(tuple, 1e-6 * np.eye(12)))),
        None,
        errors,
        np.array([[0.21, -0.04]] * 3),
    )


@pytest.mark.parametrize(
    ("misfit", "converged", "tone", "said"),
    [
        (
            1.05,
            True,
            "good",
            "What the model does not explain counts as noise: 2",
        ),
        (1.3, True, "good", "of axle 1, right, 3 Hz)"),
        (1.05, False, "notice", Finding("search-unfinished")),
    ],
)
def test_the_verdict_is_that_of_the_parts_where_they_are_read(
    commissioned, tmp_path, blank, misfit, converged, tone, said
):
    found, outcome = commissioned
    write_outcome(tmp_path, found, replace(outcome, bogie=bogie(misfit, converged)))
    page = (tmp_path / "commissioning.html").read_text(encoding="utf-8")
    assert re.findall(r'class="result (\w+)"', page) == [tone]
    assert "starts" not in page.lower()
    text = text_of(page)
    parts = f"Each part of the bogie is read: its misfit is {misfit:.2f} times the noise; springs"
    assert text.index(parts) < text.index(said)
    assert "dampers by up to 11.5 %" in text
    assert "above 1.15 something" in text
    assert "Track under the wheelsets" in text
    assert re.search(r"names a part, for the hardest.*primary springs \d", text)
    assert "Its centre towards the bogie [m]" in text
    assert "0.21" in text
    content = json.loads((tmp_path / "commissioning.json").read_text())
    assert [trip["centre_m"] for trip in content["trips"]] == [[0.21, -0.04]] * 3
    verdict = content["verdict"]
    assert verdict[0].startswith(parts)
    assert "explains" not in verdict[0]


def test_bogies_far_from_their_trips_have_their_sensors_looked_at_first():
    assert words.doubts_of_parts(bogie(words.UNTRUSTED + 1)) == [
        Finding("look-at-sensors-first", untrusted=words.UNTRUSTED)
    ]
    assert words.doubts_of_parts(bogie(words.UNTRUSTED - 1)) == []


@pytest.mark.parametrize(
    ("median", "deviation", "scale", "expected"),
    [
        (1.3e6, 0.2, 1e6, "1.30 ± 0.26"),
        (690e3, 0.2, 1e3, "690 ± 140"),
        (8.0445, 0.0002362, 1.0, "8.0445 ± 0.0019"),
        (1e5, 1.0, 1e3, "100 (37 to 270)"),
        (0.03, 1.0, 1.0, "0.030 (0.011 to 0.082)"),
        (0.0, 0.1, 1.0, "0"),
    ],
)
def test_values_show_two_digits_of_what_is_uncertain(median, deviation, scale, expected):
    low, high = median * math.exp(-deviation), median * math.exp(deviation)
    assert words._value(low, median, high, scale) == expected


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (-0.01, 0.11, "0.030 (-0.010 to 0.11)"),
        (0.0, 0.08, "0.030 (0.0000 to 0.080)"),
        (-1e-6, 0.08, "0.030 (0.0000 to 0.080)"),
        (0.021, 0.041, "0.030 ± 0.010"),
    ],
)
def test_values_that_may_be_absent_may_lie_about_0(low, high, expected):
    assert words._value(low, 0.03, high, 1.0) == expected


@pytest.mark.parametrize(
    ("name", "before", "after", "expected"),
    [
        ("stiffness_exponent", 0.0009, 0.35, None),
        ("stiffness_exponent", 0.35, 0.0009, 0.0009 / 0.35),
        ("wheelset_share", 7e-8, 2e-4, None),  # usually 0
        ("arm_share", 0.0, 0.02, None),
        ("rubber_share", 0.0, 0.02, None),
    ],
)
def test_no_change_is_relative_to_a_number_near_0(name, before, after, expected):
    quantity = next(one for one in QUANTITIES if one.name == name)
    ends = [(one - 0.01, one, one + 0.01) for one in (before, after)]
    number = words.Number(quantity, 1.0, *ends, (0.1, 0.01))
    assert number.ratio == number.as_json()["ratio"] == expected
    assert words.cells(number)["change"] == (None if expected is None else expected - 1)


def test_plus_and_minus_in_the_verdict_say_what_they_are(written):
    text = text_of(written[1])
    assert re.search(r"100 % is k p = [\d.]+ ± [\d.]+ MN/m.*\(± one standard deviation\)\.", text)


@pytest.mark.parametrize(
    ("masses", "stated"),
    [((0.66, 0.58), "0.62"), ((1.6, 1.6), "1.60"), ((1.0, 1.25), None), ((0.8, 0.82), None)],
)
def test_another_body_than_the_file_says_is_to_be_checked(masses, stated):
    doubt = words.mass_doubt(np.array(masses))
    assert (doubt is None) == (stated is None)
    if stated is not None:
        assert f"a car body of {stated} times" in doubt
        assert "body_mass_kg" in doubt
