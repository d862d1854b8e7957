"""Numbers of a vehicle that its drawings tell badly, with what is believed of them beforehand.

Each multiplies a nominal value: that of the vehicle file or, for the parts of a vehicle that files
rarely hold, the one below. Priors are log-normal, their medians the nominal values, their
deviations from what public vehicle models disagree about. Of numbers that may as well be 0, one
plus the ratio to nominal is log-normal: their logarithm could not come near 0, and what is fitted
of a part that a vehicle does not have is then taken from its neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass

PARTS = ("bushings", "rubber", "guidance", "longitudinal", "bending", "roll", "air_spring")
"""Parts that a vehicle may have beyond rigid bodies on linear springs and dampers."""


@dataclass(frozen=True)
class Quantity:
    """One number that may differ from nominal.

    Attributes
    ----------
    name : str
    deviation : float, [-]
        Standard deviation of its logarithm before any trip; 0 where it is taken as known.
    unit : str
        Of the nominal value; "" for ratios.
    meaning : str
    part : str
        The one of ``PARTS`` that it belongs to; empty if every vehicle has it.
    nominal : float or None
        None where the vehicle or the generator's settings give it.
    may_be_absent : bool
        Whether it may be 0; `deviation` is then that of log(1 + ratio to nominal).
    """

    name: str
    deviation: float
    unit: str
    meaning: str
    part: str = ""
    nominal: float | None = None
    may_be_absent: bool = False


QUANTITIES = (
    Quantity("speed", 0.0, "m/s", "speed"),
    Quantity("other_k_p", 0.0, "", "primary stiffness of the other bogie over healthy"),
    Quantity("other_c_p", 0.0, "", "primary damping of the other bogie over healthy"),
    Quantity("other_k_s", 0.0, "", "secondary stiffness of the other bogie over healthy"),
    Quantity("other_c_s", 0.0, "", "secondary damping of the other bogie over healthy"),
    Quantity("bogie_mass", 0.0, "kg", "bogie mass a side, which fixes the scale of all forces"),
    Quantity("half_wheelbase", 0.05, "m", "half wheelbase"),
    Quantity("half_pivot_distance", 0.05, "m", "half pivot distance"),
    Quantity("bogie_gyration", 0.15, "m", "radius of gyration of the bogie in pitch"),
    Quantity("body_gyration", 0.15, "m", "radius of gyration of the body in pitch"),
    Quantity("healthy_k_p", 0.2, "N/m", "healthy primary stiffness"),
    Quantity("healthy_c_p", 0.4, "N s/m", "healthy primary damping"),
    Quantity("healthy_k_s", 0.2, "N/m", "healthy secondary stiffness"),
    Quantity("healthy_c_s", 0.3, "N s/m", "healthy secondary damping"),
    Quantity("primary_bushing", 1.0, "N/m", "bushing of the primary damper", "bushings", 2e6),
    Quantity("secondary_bushing", 1.0, "N/m", "bushing of the secondary damper", "bushings", 1e7),
    Quantity(
        "rubber_share",
        0.6,
        "",
        "stiffness of the rubber's Maxwell branch over k_p",
        "rubber",
        0.05,
        may_be_absent=True,
    ),
    Quantity(
        "rubber_frequency",
        0.3,
        "Hz",
        "relaxation frequency of the rubber's Maxwell branch",
        "rubber",
        5.0,
    ),
    Quantity(
        "rubber_loss", 0.6, "", "loss factor of the rubber", "rubber", 0.03, may_be_absent=True
    ),
    Quantity(
        "guidance_stiffness",
        0.9,
        "",
        "pitch stiffness of the axle guidance over k_p a²",
        "guidance",
        0.1,
        may_be_absent=True,
    ),
    Quantity(
        "guidance_damping",
        0.9,
        "",
        "pitch damping of the axle guidance over c_p a²",
        "guidance",
        0.1,
        may_be_absent=True,
    ),
    Quantity(
        "longitudinal_stiffness",
        1.0,
        "N/m",
        "stiffness of the longitudinal links, a side",
        "longitudinal",
        1e5,
    ),
    Quantity(
        "longitudinal_damping",
        1.0,
        "N s/m",
        "damping of the longitudinal links, a side",
        "longitudinal",
        1e4,
    ),
    Quantity(
        "body_lever",
        0.3,
        "m",
        "lever of the longitudinal links below the body's centre",
        "longitudinal",
        0.75,
    ),
    Quantity(
        "bogie_lever",
        0.3,
        "m",
        "lever of the longitudinal links above the bogie's centre",
        "longitudinal",
        0.42,
    ),
    Quantity(
        "bending_frequency", 0.25, "Hz", "frequency of the body's first bending", "bending", 10.0
    ),
    Quantity(
        "bending_damping", 0.5, "", "damping ratio of the body's first bending", "bending", 0.015
    ),
    Quantity(
        "bending_at_pivot", 0.5, "", "shape of the first bending at the pivots", "bending", 0.45
    ),
    Quantity(
        "bending_at_sensor", 0.5, "", "shape of the first bending at the sensor", "bending", 0.45
    ),
    Quantity(
        "bending_slope",
        0.5,
        "",
        "slope of the first bending at the pivots times half their distance",
        "bending",
        2.25,
    ),
    Quantity(
        "body_roll_gyration", 0.25, "m", "radius of gyration of the body in roll", "roll", 1.3
    ),
    Quantity(
        "bogie_roll_gyration", 0.25, "m", "radius of gyration of the bogie in roll", "roll", 0.8
    ),
    Quantity("primary_lateral", 0.2, "m", "half distance of the primary springs", "roll", 1.0),
    Quantity("secondary_lateral", 0.2, "m", "half distance of the secondary springs", "roll", 1.0),
    Quantity("anti_roll_bar", 1.0, "N m/rad", "stiffness of a bogie's anti-roll bar", "roll", 1e6),
    Quantity(
        "lateral_stiffness",
        1.0,
        "N/m",
        "lateral stiffness between body and bogie, a side",
        "roll",
        1.6e5,
    ),
    Quantity(
        "lateral_damping",
        1.0,
        "N s/m",
        "lateral damping between body and bogie, a side",
        "roll",
        1.6e4,
    ),
    Quantity(
        "cross_level", 0.7, "", "density of half the cross level over the mean's", "roll", 0.5
    ),
    Quantity("axle_box_lateral", 0.1, "m", "lateral place of the axle box's sensor", "roll"),
    Quantity("frame_lateral", 0.1, "m", "lateral place of the frame's sensor", "roll"),
    Quantity("body_lateral", 0.1, "m", "lateral place of the body's sensor", "roll"),
    Quantity("volume_ratio", 0.5, "", "auxiliary volume over the air spring's", "air_spring", 2.0),
    Quantity("area_share", 1.0, "", "change of area over k_s", "air_spring", 0.1),
)
UNMEASURED = tuple(quantity.name for quantity in QUANTITIES)
"""Names of the quantities: columns of ratios after ``PARAMETERS``, the speed first."""
OFFSETS = {quantity.name: float(quantity.may_be_absent) for quantity in QUANTITIES}
"""What is added to each ratio before its logarithm is taken: 1 where it may be absent, else 0."""
