"""The AM96 with its geometry, for tests that need it at import."""

from suspnet.dynamics import Vehicle

AM96 = Vehicle(  # configs/vehicle/am96.yaml
    "am96",
    1725.0,
    6300.0,
    1.30e6,
    3.7e3,
    0.69e6,
    22.6e3,
    half_wheelbase_m=1.35,
    half_pivot_distance_m=9.5,
    bogie_gyration_m=0.8,
    body_gyration_m=7.8,
)
