"""Names and units of the estimated parameters, and of the directions of travel."""

from __future__ import annotations

from typing import Literal

PARAMETERS = ("k_p", "c_p", "k_s", "c_s", "M_s")
"""The parameters that may vary, in the order of every array of parameter ratios (1 = healthy)."""
PAYLOAD = "M_s"
"""Name of the car-body mass, which varies with the payload from trip to trip."""
SI_COLUMNS = {
    "k_p": "k_p_n_per_m",
    "c_p": "c_p_ns_per_m",
    "k_s": "k_s_n_per_m",
    "c_s": "c_s_ns_per_m",
    "M_s": "M_s_kg",
}
"""Columns of the parameters in SI units."""
NAMES = {
    "k_p": "stiffness of the primary spring",
    "c_p": "damping of the primary damper",
    "k_s": "stiffness of the secondary spring",
    "c_s": "damping of the secondary damper",
    "M_s": "mass of the car body",
}
UNITS = {"k_p": "N/m", "c_p": "N s/m", "k_s": "N/m", "c_s": "N s/m", "M_s": "kg"}
"""SI unit of each parameter."""
Direction = Literal["forward", "reverse"]
FORWARD: Direction = "forward"
"""The direction of travel in which the leading end of the vehicle runs ahead."""
REVERSE: Direction = "reverse"
DIRECTIONS: tuple[Direction, ...] = (FORWARD, REVERSE)
