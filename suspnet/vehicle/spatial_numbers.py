"""Places of sensors and uncertain numbers of a vehicle of twelve separate springs and dampers.

The rows are fields of `suspnet.vehicle.quantities.Quantity` after the part. Nominal values of the
lateral numbers are those of the passenger vehicle of the Manchester benchmarks (Iwnicki, Vehicle
System Dynamics 30, 295, 1998) as multibody programs publish it, rounded; the creep coefficient is
that of Kalker's linear theory for a wheel load of about 50 kN. Yaw dampers are those of high-speed
bogies, 100 to 500 kN s/m behind bushings of 5 to 10 MN/m (from memory: no source was at hand).
"""

from __future__ import annotations

from typing import Any

from suspnet.ground.parameters import COMPONENTS, CORNERS, SIDES

IN_BETWEEN = tuple(
    f"{place}_axle{axle}_middle" for place in ("axle_box", "frame") for axle in (1, 2)
)
"""Places of sensors in the middle, or of the mean of a left and a right one: they show no part."""
PLACES = (
    *(f"axle_box_{corner}" for corner in CORNERS),
    *(f"frame_{corner}" for corner in CORNERS),
    *(f"frame_centre_{side}" for side in (*SIDES, "middle")),
    *(f"body_{side}" for side in (*SIDES, "middle")),
    *IN_BETWEEN,
)
"""Places of vertical accelerometers: axle boxes of the measured bogie, its frame above the axles or
at its centre, the body above the bogie; axles and sides as in ``CORNERS``."""
ADDITIONS: dict[str, tuple[str, ...]] = {
    "frame_sway": ("y_1", "y_2"),
    "frame_yaw": ("chi_1", "chi_2"),
    "body_yaw": ("chi",),
    "creep": tuple(f"{motion}_w{wheel}" for wheel in range(1, 5) for motion in ("y", "chi")),
    "torsion": ("tau_1", "tau_2"),
}
"""Parts that only this vehicle may have, each with its coordinates."""
LATERAL = ("frame_sway", "frame_yaw", "creep")
"""Parts with which the alignment of the track reaches the bogie frames."""

SPATIAL_NUMBERS: dict[str, tuple[tuple[Any, ...], ...]] = {
    "": tuple(
        (f"healthy_{name}", 0.05, "", f"healthy {name} over the mean of its kind")
        for name in COMPONENTS[:-1]
    )
    + tuple(
        (f"other_{name}", 0.05, "", f"{name} of the other bogie over the mean of its kind")
        for name in COMPONENTS[:-1]
    ),
    "lateral": (
        ("guide_stiffness", 0.5, "N/m", "lateral stiffness of an axle box to the frame", 4e6),
        ("guide_damping", 1.0, "N s/m", "lateral damping of an axle box to the frame", 1e4),
        ("guide_lever", 0.5, "m", "height of the bogie's centre above the axles", 0.14),
        ("wheel_radius", 0.05, "m", "radius of the wheels", 0.46),
        ("alignment", 0.7, "", "density of the alignment over the mean's", 0.5),
    ),
    "frame_yaw": (
        ("bogie_yaw", 0.15, "", "radius of gyration of the bogie in yaw over that in pitch", 1.4),
    ),
    "body_yaw": (
        ("body_yaw", 0.1, "", "radius of gyration of the body in yaw over that in pitch", 1.0),
    ),
    "creep": (
        ("wheelset_mass", 0.2, "kg", "mass of a wheelset", 1800.0),
        ("wheelset_yaw_gyration", 0.1, "m", "radius of gyration of a wheelset in yaw", 0.8),
        ("axle_box_stiffness", 0.7, "N/m", "longitudinal stiffness of an axle box", 1.5e7),
        ("axle_box_damping", 0.7, "N s/m", "longitudinal damping of an axle box", 3e4, True),
        ("creep_coefficient", 0.4, "N", "creep force of a wheel over its creepage", 6e6),
        ("creep_ratio", 0.2, "", "lateral over longitudinal creep coefficient", 0.9),
        ("conicity", 0.7, "", "equivalent conicity of the wheels", 0.05),
    ),
    "yaw_dampers": (
        ("yaw_damping", 1.0, "N s/m", "damping of a yaw damper, a side of a bogie", 2e5, True),
        ("yaw_bushing", 0.7, "N/m", "bushings of a yaw damper", 6e6),
        ("yaw_lateral", 0.2, "m", "half distance of the yaw dampers", 1.3),
        ("yaw_height", 0.2, "m", "height of the yaw dampers above the links", 1.0, True, 0.0),
    ),
    "torsion": (
        ("torsion_frequency", 0.25, "Hz", "frequency of the free frame's first torsion", 35.0),
        ("torsion_damping", 0.5, "", "damping ratio of the frame's first torsion", 0.02),
        (
            "torsion_rise",
            0.5,
            "",
            "rise of a frame's corners in torsion for a modal mass of a fifth of the frame's",
            1.0,
            True,
        ),
    ),
    "wheelsets": (
        (
            "wheelset_roll_share",
            1.0,
            "",
            "density of the roll that excites each wheelset alone over the mean track's",
            0.002,
            True,
            0.0,
        ),
    ),
    "sensors": (
        *((f"gain_{place}", 0.02, "", f"sensitivity of {place}", 1.0) for place in PLACES),
        *((f"delay_{place}", 0.1, "s", f"delay of {place}", 5e-3, True, 0.0) for place in PLACES),
    ),
}
"""Numbers by part; "" is for every such vehicle. Sensitivity and delay of a sensor are relative to
the first one of the vehicle's list."""
