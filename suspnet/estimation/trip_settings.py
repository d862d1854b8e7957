"""How trips are read."""

from dataclasses import dataclass

from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.settings import check_settings, setting

LEAST_TRIPS = 3
"""Smallest number of healthy trips; fewer contain too little information on a vehicle."""
N_HEALTHY = 5  # number of first trips that are taken as healthy, as train.yaml has it


@dataclass(frozen=True)
class TripSettings:
    """How trips are read, and the conditions for an estimate.

    Raises
    ------
    TypeError, ValueError
        If a setting has the wrong type or is out of range.
    """

    rate_hz: float = setting(
        100.0, "Rate to which the three channels are resampled", "Hz", low=20, high=1000
    )
    speed_tolerance: float = setting(
        0.02,
        "Largest deviation of the speed within a segment from its mean, and of segments that are "
        "averaged from their middle, relative to it",
        low=0,
        high=0.5,
    )
    min_speed_m_per_s: float = setting(
        10.0,
        "Lowest speed that is used, for models that do not depend on the speed",
        "m/s",
        low=0,
        high=200,
    )
    min_coherence: float = setting(
        0.3,
        "Coherence with the trip's response below which a segment is left out, if it is also "
        "much lower than that of the others",
        low=0,
        high=1,
    )
    min_averages: float = setting(
        10.0,
        "Number of independent averages of a frequency bin below which it gives no estimate",
        low=3,
        high=1e6,
    )
    max_deviation: float = setting(
        0.3,
        "Standard deviation of the measured log-magnitudes, median over the bins, above which "
        "there is no estimate",
        low=0,
        high=10,
    )
    level: float = setting(
        INTERVAL_LEVEL, "Probability with which an interval holds the truth", low=0.01, high=0.999
    )
    check_channels: bool = setting(
        True, "Whether to look for wrong units (the speed's too), wrong signs and swapped channels"
    )

    def __post_init__(self) -> None:
        check_settings(self, "trips")
