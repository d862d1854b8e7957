"""Names of the parameters that are estimated, and how a mileage is written."""

from __future__ import annotations

PARAMETERS = ("k_p", "c_p", "k_s", "c_s", "M_s")
"""The parameters that may vary, in the order of every array of parameter ratios (1 = healthy)."""
PAYLOAD = "M_s"
"""Name of the car-body mass, which the payload changes from trip to trip."""
SI_COLUMNS = {
    "k_p": "k_p_n_per_m",
    "c_p": "c_p_ns_per_m",
    "k_s": "k_s_n_per_m",
    "c_s": "c_s_ns_per_m",
    "M_s": "M_s_kg",
}
"""Columns of the parameters in SI units."""


def km_words(value: float) -> str:
    """Return a mileage with its unit and spaces between thousands."""
    return f"{value:,.0f} km".replace(",", " ")
