"""The effects of rich trains by name, the sets of rough ones, and how their numbers scatter."""

FAMILY = (
    "healthy",
    "inertias",
    "geometry",
    "bushings",
    "rubber",
    "guidance",
    "longitudinal",
    "bending",
    "roll",
    "contact",
)
OF_THE_TRIP = ("payload", "sensors", "wheelsets", "axle_box_arm")
OUTSIDE = ("second_bending", "one_side", "unequal", "blow_off", "friction", "drift", "bogie_mass")
FLEXIBLE = ("second_bending", "torsion", "equipment", "frame_torsion", "floors")
LAWS = ("blow_off", "rebound", "friction", "secondary_friction", "air_spring")
"""Effects that make a train nonlinear, so that it has no exact spectra."""
ON_THE_LINE = (
    *("out_of_round", "welds", "crossings", "changing_roughness"),
    *("wander", "heat", "load_shift"),
)
RECORDED = ("coloured_noise", "mains", "resolution")
ROUGH = (
    *(*FLEXIBLE[1:], "ballast", "worn_wheels", "cross_axis"),
    *(*LAWS[1:2], *LAWS[3:], *ON_THE_LINE, *RECORDED),
)
EFFECTS = (*FAMILY, *OF_THE_TRIP, *OUTSIDE, *ROUGH)
"""What a train can have.

``FAMILY`` is what suspnet's family of vehicles knows, the contact aside. ``ON_THE_LINE``,
``RECORDED``, drift of the speed and the noise of sensors are of trips in time alone
(rich_train_trips.py). Dampers with laws have bushings, whether these are asked for or not.
"""
BASE = (*FAMILY, "unequal", "payload")
NONLINEAR = LAWS[:4]
SETS = {
    "family": BASE,
    "flexible modes": (*BASE, *FLEXIBLE),
    "cross-axis and noise": (*BASE, "worn_wheels", "cross_axis", "coloured_noise", "mains"),
    "ballast": (*BASE, "ballast"),
    "nonlinear": (*BASE, *NONLINEAR),
    "nonlinear, air springs": (*BASE, *NONLINEAR, "air_spring"),
    "all": (
        *(*BASE, *FLEXIBLE, *NONLINEAR, *ON_THE_LINE, *RECORDED),
        *("ballast", "worn_wheels", "cross_axis", "sensors", "bogie_mass"),
    ),
}
"""Effects of the rough trains by which suspnet is judged."""

UNEQUAL = 0.05
"""Standard deviation of the logarithm of each spring and damper of a train that is unequal."""
SCATTER = {
    "healthy": {"k_p": 0.2, "c_p": 0.4, "k_s": 0.2, "c_s": 0.3},
    "inertias": {"body_gyration": 0.15, "bogie_gyration": 0.15},
    "geometry": {"half_wheelbase": 0.05, "half_pivot_distance": 0.05},
    "bushings": {"primary_bushing_n_per_m": 0.7, "secondary_bushing_n_per_m": 0.7},
    "rubber": {"maxwell_share": 0.5, "maxwell_hz": 0.3},
    "guidance": {"guidance_height_m": 0.5, "guidance_ns_per_m": 0.7},
    "longitudinal": {
        "longitudinal_n_per_m": 0.7,
        "longitudinal_ns_per_m": 0.7,
        "body_arm_m": 0.1,
        "bogie_arm_m": 0.1,
    },
    "bending": {"bending_hz": 0.2, "bending_damping": 0.4, "body_length_m": 0.05},
    "roll": {
        "body_roll_gyration_m": 0.2,
        "bogie_roll_gyration_m": 0.2,
        "primary_half_m": 0.05,
        "secondary_half_m": 0.05,
        "anti_roll_nm": 0.7,
        "lateral_n_per_m": 0.3,
        "lateral_ns_per_m": 0.3,
        "cross_level": 0.4,
        "alignment": 0.4,
    },
    "contact": {"contact_n_per_m": 0.2, "contact_ns_per_m": 0.3},
    "second_bending": {"second_bending_hz": 0.15},
    "bogie_mass": {"bogie_mass": 0.05},
}
"""Half widths: a true number is drawn evenly in its logarithm about the drawing's."""
SHIFTS = {
    "payload": {
        "bending_exponent": (0.0, 0.5),
        "gyration_exponent": (-0.1, 0.1),
        "stiffness_exponent": (0.0, 0.8),
        "damping_exponent": (0.0, 0.4),
    },
    "sensors": {
        **{f"sensitivity_{i}": (0.98, 1.02) for i in range(6)},
        **{f"late_s_{i}": (-3e-4, 3e-4) for i in range(6)},
        # drawn last: numbers of the six do not depend on the others
        **{f"sensitivity_{i}": (0.98, 1.02) for i in range(6, 9)},
        **{f"late_s_{i}": (-3e-4, 3e-4) for i in range(6, 9)},
    },
    "wheelsets": {"wheelset_share": (0.001, 0.01)},
    "axle_box_arm": {"sensor_on_arm": (-0.1, 0.1)},
    "torsion": {"torsion_hz": (8.0, 13.0), "torsion_damping": (0.01, 0.03)},
    "equipment": {
        "equipment_kg": (2000.0, 4500.0),
        "equipment_hz": (5.0, 9.0),
        "equipment_damping": (0.03, 0.1),
        "equipment_x_m": (-4.0, 4.0),
        "equipment_y_m": (-0.4, 0.4),
    },
    "frame_torsion": {"frame_torsion_hz": (20.0, 40.0), "frame_torsion_damping": (0.01, 0.03)},
    "floors": {
        "floors_hz": (10.0, 18.0),
        "floors_right_hz": (10.0, 18.0),
        "floors_damping": (0.03, 0.1),
    },
    "ballast": {
        "ballast_n_per_m": (6e7, 1.2e8),
        "ballast_ns_per_m": (1.5e5, 2.5e5),
        "track_kg": (800.0, 1200.0),
    },
    # new wheels have 0.03 to 0.05; with more, lateral acceleration nears the vertical one
    "worn_wheels": {"conicity": (0.08, 0.13)},
    # evenly drawn, with a standard deviation of 2 %
    "cross_axis": {f"cross_axis_{i}": (-0.02 * 3**0.5, 0.02 * 3**0.5) for i in range(9)},
    "rebound": {"rebound_share": (0.05, 0.25)},
    "secondary_friction": {"secondary_friction_n": (50.0, 200.0)},
    "air_spring": {"closed_choke": (0.8, 2.0)},
}
"""Ends of the ranges of numbers that are drawn evenly."""
