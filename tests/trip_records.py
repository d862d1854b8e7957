"""Made-up results of trips, for the tests of trends, figures and reports."""

from dataclasses import replace

import numpy as np

from suspnet.ground.findings import Finding
from suspnet.ground.records import NO_ESTIMATE, Place, Quality, TripCurves, TripResult
from suspnet.trains.maintenance.alarms import Watched
from suspnet.trains.maintenance.series import series_of
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.trend import trend_of_trips

OUTPUTS = ("k_p", "c_p", "k_s", "c_s", "M_s")
SPREAD = {"k_p": 0.002, "c_p": 0.02, "k_s": 0.006, "c_s": 0.008, "M_s": 0.03}
HALF_WIDTHS = {"k_p": 0.0033, "c_p": 0.033, "k_s": 0.01, "c_s": 0.013, "M_s": 0.05}
FLAG = Finding("outside-range", name="k_p", ratio=27.0, low=50.0, high=160.0)


def curves(seed=0, n_freq=120, n_windows=200, stiffness=1.0):
    """Return curves that look like those of a car at 70 m/s."""
    rng = np.random.default_rng(seed)
    frequencies = np.linspace(0.5, 12.0, n_freq)
    peaks_hz = np.array([[5.0], [1.2]]) * np.sqrt(stiffness)
    relative = frequencies / peaks_hz
    responses = (1 + 0.3j * relative) / (1 - relative**2 + 0.3j * relative)
    deviations = np.stack([0.03 + 0.1 / frequencies, 0.05 + 0.02 * frequencies])
    responses = responses * np.exp(0.3 * deviations * rng.normal(size=deviations.shape))
    seconds = 6.0 * np.arange(n_windows)
    amplitude = np.array([[12.0], [3.0], [0.4]]) * rng.uniform(0.7, 1.3, (3, n_windows))
    ramp = np.clip(np.minimum(seconds, seconds[-1] - seconds) / 120.0, 0.0, 1.0)
    return TripCurves(
        frequencies_hz=frequencies,
        responses=responses,
        coherences=np.exp(-deviations),
        deviations=deviations,
        overview_s=seconds,
        overview_low=-amplitude * ramp,
        overview_high=amplitude * ramp,
        overview_mean=0.02 * amplitude * rng.normal(size=amplitude.shape) * ramp,
        overview_speed=70.0 * ramp,
    )


def trip(i=0, change=None, missing=False, with_curves=True, **fields):
    """Return the i-th trip of a vehicle; `change` maps a parameter to its true ratio."""
    rng = np.random.default_rng(1000 + i)
    truth = {name: 1.0 for name in OUTPUTS} | (change or {})
    estimates = {name: truth[name] * (1 + SPREAD[name] * rng.normal()) for name in OUTPUTS}
    quality = Quality(
        coherence_p=0.9 + 0.05 * rng.random(),
        coherence_s=0.7 + 0.1 * rng.random(),
        n_averages=90.0 + 10 * rng.random(),
        segments_used=110,
        segments_total=120,
        duration_s=1200.0,
        usable_percent=20.0 if missing else 97.0 + 3 * rng.random(),
        speed_m_per_s=70.0,
        speed_bins="65-75 m/s: 95",
        faults="axle_box: 0.4 s of gaps" if i % 7 == 3 else "",
    )
    status = {"status": NO_ESTIMATE, "reason": f"only {i} averages, 20 are needed"}
    given = {
        "trip": f"trip_{i:03d}",
        "manifest": f"trip_{i:03d}.yaml",
        "vehicle": "AM96 217",
        "place": Place("bogie 1, left"),
        "mileage_km": 10_000.0 * (i + 1),
        "start": f"2024-01-{i % 28 + 1:02d}T08:15:00",
        "estimates": {} if missing else estimates,
        "truth": truth,
        "quality": quality,
        "curves": curves(i, stiffness=truth["k_p"]) if with_curves and not missing else None,
    }
    return TripResult(**(given | (status if missing else {}) | fields))


def fleet(n_trips=30, missing=(4, 17), **options):
    """Return trips of a vehicle whose k_p falls by 1 % at 250 000 km and c_s fades at the end."""
    return [
        trip(
            i,
            {
                "k_p": 1.0 if i < 24 else 0.99,
                "c_s": 1.0 - 0.4 * float(np.clip((i - 19) / 10, 0, 1)),
            },
            i in missing,
            **options,
        )
        for i in range(n_trips)
    ]


def flagged(result, **estimates):
    """Return a trip that is flagged, with other estimates."""
    return replace(
        result, flags=FLAG, half_widths=HALF_WIDTHS, estimates=result.estimates | estimates
    )


def trend_of(results, outputs=OUTPUTS, level=0.9, commissionings=(), **known):
    """Return what figures show of trips; `known` is limits, alarms, lives and events."""
    series = series_of(results, known.get("events", ()))
    watched = Watched(known.get("alarms", []))
    state = State(series, known.get("limits", {}), watched, known.get("lives", {}))
    return trend_of_trips(results, state, outputs, level, commissionings)
