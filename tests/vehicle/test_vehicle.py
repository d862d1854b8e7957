"""The numbers of a vehicle: printed coefficients, unit slips, immutability."""

import math

import numpy as np
import pytest
import torch

from suspnet.ground.parameters import DEFAULT_LIMITS, kind_of
from suspnet.vehicle import PARAMETERS, QuarterCar, Vehicle

NUMBERS = {
    "bogie_mass_kg": 1725.0,
    "body_mass_kg": 6300.0,
    "primary_stiffness_n_per_m": 1.30e6,
    "primary_damping_ns_per_m": 3.7e3,
    "secondary_stiffness_n_per_m": 0.69e6,
    "secondary_damping_ns_per_m": 22.6e3,
}


def rounded_as_printed(values, significant=3):
    return [float(f"{value:.{significant}g}") for value in values]


# reference


def test_shipped_am96_is_that_of_table_iii_in_si_units(am96):
    assert {key: getattr(am96, key) for key in NUMBERS} == NUMBERS


def test_g_s_coefficients_are_those_printed_in_section_iii_b(am96):
    _, _, numerator, denominator = QuarterCar(am96).transfer_coefficients(torch.ones(1, 5))
    assert (numerator[0] / 100).tolist() == [6900, 226]
    assert (denominator[0] / 100).tolist() == [6900, 226, 63]


def test_g_p_coefficients_are_those_printed_in_section_iii_b(am96):
    numerator, denominator, _, _ = QuarterCar(am96).transfer_coefficients(torch.ones(1, 5))
    # The paper cancels a further common factor: both are printed divided by 2500 overall, that
    # is, 8.97e11 / 2500 = 3.59e8. It prints three digits, and four where they are exact.
    numerator, denominator = ((c[0] / 2500).tolist() for c in (numerator, denominator))
    assert rounded_as_printed(numerator) == [3.59e8, 1.28e7, 3.31e6, 9320]
    assert numerator[3] == pytest.approx(9324, abs=0.5)
    assert rounded_as_printed(denominator[:3]) == [3.59e8, 1.28e7, 5.52e6]
    assert denominator[3:] == pytest.approx([81870, 4347], abs=0.5)


def test_uncoupled_frequencies_and_damping_ratios_match_their_formulas(am96):
    assert am96.primary_frequency_hz == pytest.approx(
        math.sqrt(1.30e6 / 1725) / math.tau, rel=1e-12
    )
    assert am96.secondary_frequency_hz == pytest.approx(
        math.sqrt(0.69e6 / 6300) / math.tau, rel=1e-12
    )
    assert am96.primary_damping_ratio == pytest.approx(0.03907, rel=1e-3)
    assert am96.secondary_damping_ratio == pytest.approx(0.17139, rel=1e-3)


# property


@pytest.mark.parametrize("name", PARAMETERS)
def test_degraded_multiplies_one_parameter_and_leaves_the_original(am96, name):
    before = am96.healthy_values()
    changed = am96.degraded(**{name: 0.5})
    ratios = np.array(changed.healthy_values()) / before
    expected = [0.5 if other == name else 1.0 for other in PARAMETERS]
    assert ratios.tolist() == expected
    assert changed.bogie_mass_kg == am96.bogie_mass_kg
    assert changed.name == am96.name
    assert am96.healthy_values() == before


def test_degraded_ratios_of_the_generator_and_of_the_vehicle_agree(am96):
    ratios = dict(zip(PARAMETERS, (0.6, 1.7, 1.3, 0.8, 1.1), strict=True))
    frequencies = torch.linspace(0.1, 20, 50, dtype=torch.float64)
    by_vehicle = QuarterCar(am96.degraded(**ratios)).magnitudes(torch.ones(1, 5), frequencies)
    by_ratio = QuarterCar(am96).magnitudes(
        torch.tensor([list(ratios.values())], dtype=torch.float64), frequencies
    )
    torch.testing.assert_close(by_vehicle, by_ratio, rtol=1e-12, atol=0)


# failure


def test_limits_are_checked_and_named():
    with pytest.raises(ValueError, match=r"`limits\.k_p`: `act\[0\]` must be a finite number >= 0"):
        Vehicle("wrong", **NUMBERS, limits={"k_p": {"act": [1.2, 1.6]}})
    with pytest.raises(TypeError, match="`limits` must map parameters to their limits"):
        Vehicle("wrong", **NUMBERS, limits=[0.9, 1.1])


def test_limits_are_plain_and_no_part_of_what_a_vehicle_is():
    rules = {
        "k_p": {"notice": [0.95, 1.05], "why": "rule 7"},
        "c_p": {"act": [0.5, None]},
        "k_s": None,
    }
    plain, limited = Vehicle("one", **NUMBERS), Vehicle("one", **NUMBERS, limits=rules)
    assert plain == limited
    assert hash(plain) == hash(limited)
    assert limited.limits["k_p"] == {"notice": [0.95, 1.05], "act": [0.8, 1.25], "why": "rule 7"}
    assert limited.limits["c_p"]["act"] == [0.5, None]
    assert limited.limits["k_s"] is None
    assert {kind_of(name) for name in limited.known_limits} == {"k_p", "c_p", "c_s"}
    assert limited.known_limits["c_p"].why == "the file of vehicle one"
    assert plain.known_limits == DEFAULT_LIMITS
    again = Vehicle("one", **NUMBERS, limits=limited.limits)
    assert again.limits == limited.limits
    assert limited.degraded(k_p=0.5).limits == limited.limits


@pytest.mark.parametrize(
    ("name", "factor", "message"),
    [
        ("primary_stiffness_n_per_m", 1e-3, r"primary.*kN/m \(multiply by 1e3\)"),
        ("secondary_stiffness_n_per_m", 1e3, "secondary.*1e3 too large"),
        ("bogie_mass_kg", 1e-3, "primary.*mass in tonnes"),
        ("body_mass_kg", 1e3, "secondary.*mass in grams"),
        ("primary_damping_ns_per_m", 1e-3, "primary damping.*in kN s/m"),
        ("secondary_damping_ns_per_m", 1e3, "secondary damping.*1e3 too large"),
        ("bogie_mass_kg", 0.0, "`bogie_mass_kg` must be a finite number > 0"),
        ("secondary_stiffness_n_per_m", math.nan, "must be a finite number > 0"),
    ],
)
def test_unit_slip_is_rejected_and_named(name, factor, message):
    with pytest.raises(ValueError, match=message):
        Vehicle("slipped", **NUMBERS | {name: NUMBERS[name] * factor})
