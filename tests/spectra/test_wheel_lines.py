"""Out-of-round wheels are found by their order and size, and their bins are left out."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import torch
from trip_fixtures import model_at
from vehicles import AM96

from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.estimation.from_spectra import estimate_with_noise
from suspnet.trains.recordings.manifest import CHANNELS, TripManifest
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.simulation.signals import (
    profile_length_m,
    service_journey,
    simulate_trip,
    steady_journey,
)
from suspnet.trains.spectra.wheel_lines import line_bins, wheel_lines, wheel_words
from suspnet.vehicle import QuarterCar
from suspnet.vehicle.track import make_profile, track_spectrum

RATE_HZ = 100.0
MANIFEST = TripManifest(
    path=Path("trip.yaml"),
    name="trip",
    vehicle="",
    suspension="",
    mileage_km=0,
    speed=1,
    channels={},
)


class OutOfRound(NamedTuple):
    """Wheels whose radius varies by `size_m` cos(`order` times the angle)."""

    order: int
    size_m: float
    diameter_m: float

    def on(self, profile):
        """Return a track on which the only wheelset of a vehicle moves as with these wheels."""
        per_m = 2 * self.order / self.diameter_m
        angle = per_m * profile.step_m * np.arange(len(profile.slope))
        radius = self.size_m * np.cos(angle)
        return replace(
            profile,
            elevation_m=profile.elevation_m + radius,
            slope=profile.slope - per_m * self.size_m * np.sin(angle),
            curvature_per_m=profile.curvature_per_m - per_m**2 * radius,
        )


def recorded(journey, wheels=None, seed=0, track="german_low", **changes):
    """Return the recording of a trip, its axle box alone with a track and a noise."""
    system = QuarterCar(AM96).motion_system(torch.ones(5))
    spectrum = track_spectrum(track)
    step_m = journey.speeds_m_per_s.max() / RATE_HZ / 2
    profile = make_profile(spectrum, profile_length_m(system, journey), step_m, seed)
    profile = profile if wheels is None else wheels.on(profile)
    signals = simulate_trip(system, profile, journey, RATE_HZ)
    signals += 0.02 * np.random.default_rng(seed).standard_normal(signals.shape)
    n = signals.shape[1]
    _, speed, _ = journey.at(np.arange(n) / RATE_HZ)
    manifest = replace(MANIFEST, **changes)
    usable = np.ones(n, dtype=bool)
    values = dict(zip(CHANNELS, signals, strict=True))
    return Recording(manifest, RATE_HZ, values, usable, speed, (), n / RATE_HZ)


# reference


@pytest.mark.parametrize(
    ("journey", "order", "mm", "diameter_m"),
    [
        (steady_journey(70.0, 300.0), 1, 0.3, 0.92),
        (steady_journey(30.0, 300.0), 2, 0.1, 0.88),
        (steady_journey(18.0, 400.0), 3, 0.1, 0.76),
        (service_journey(40.0, 800.0, 1, seed=1), 1, 0.2, 0.84),
    ],
    ids=["order 1, fast", "order 2", "order 3, worn wheel", "with a stop"],
)
def test_order_size_and_diameter_are_found_within_a_tenth(journey, order, mm, diameter_m):
    recording = recorded(journey, OutOfRound(order, 1e-3 * mm, diameter_m))
    (line,) = wheel_lines(recording)
    assert (line.channel, line.order) == ("axle_box", order)
    assert line.size_mm == pytest.approx(mm, rel=0.1)
    assert line.diameter_m == pytest.approx(diameter_m, rel=0.01)
    v = line.speed_m_per_s  # the same amplitude as an acceleration
    assert line.m_per_s2 == pytest.approx(1e-3 * mm * (2 * order * v / diameter_m) ** 2, rel=0.1)
    assert wheel_words(recording, [line]).startswith(f"out-of-round wheel of {line.diameter_m:.3f}")


# limits


@pytest.mark.parametrize("speed", [17.0, 35.0, 70.0])
@pytest.mark.parametrize("track", ["german_high", "chinese_ballastless"])
def test_round_wheels_give_no_finding(speed, track):
    for seed in range(3):
        recording = recorded(steady_journey(speed, 5000 / speed), seed=seed, track=track)
        assert (wheel_lines(recording), wheel_words(recording, ())) == ((), "")


def test_it_is_said_that_no_order_is_in_reach():
    recording = recorded(steady_journey(95.0, 100.0), OutOfRound(1, 3e-4, 0.92))
    assert wheel_lines(recording) == ()
    assert "wheels cannot be seen" in wheel_words(recording, ())
    assert "raise trips.rate_hz" in wheel_words(recording, ())


def test_a_given_diameter_excludes_a_period_of_the_track():
    wheels = OutOfRound(1, 2e-4, 0.80)  # as a slab of 2.51 m
    journey = steady_journey(40.0, 200.0)
    assert [one.order for one in wheel_lines(recorded(journey, wheels))] == [1]
    assert wheel_lines(recorded(journey, wheels, wheel_diameter_m=0.88)) == ()
    (line,) = wheel_lines(recorded(journey, wheels, wheel_diameter_m=0.81))
    assert "found within" not in wheel_words(recorded(journey, wheel_diameter_m=0.81), [line])


def test_a_period_of_a_part_of_the_track_is_no_wheel():
    journey = steady_journey(40.0, 300.0)
    quiet, one = recorded(journey), recorded(journey, OutOfRound(1, 2e-4, 0.85))
    signals = quiet.signals.copy()
    signals[:, :10_000] = one.signals[:, :10_000]
    assert wheel_lines(one)
    assert wheel_lines(replace(one, values=dict(zip(CHANNELS, signals, strict=True)))) == ()


def test_the_side_of_a_pair_is_named():
    journey = steady_journey(40.0, 200.0)
    left, right = recorded(journey, OutOfRound(1, 2e-4, 0.85)), recorded(journey)
    sides = {"axle_box left": left.signals[0], "axle_box right": right.signals[0]}
    both = replace(left, values=sides | dict(zip(CHANNELS[1:], left.signals[1:], strict=True)))
    (line,) = wheel_lines(both)
    assert line.channel == "axle_box left"
    assert line.size_mm == pytest.approx(0.2, rel=0.1)


# the estimate


def test_bins_of_a_line_follow_the_speeds():
    (line,) = wheel_lines(recorded(steady_journey(30.0, 300.0), OutOfRound(1, 2e-4, 0.9)))
    bins = torch.arange(1, 401, dtype=torch.float64) / 20
    held = bins[line_bins([line], torch.tensor([[29.5, 30.0], [30.0, 30.5]]), bins, 20.0)]
    first, last = 29.5 / (np.pi * 0.9), 30.5 / (np.pi * 0.9)
    assert first - 0.6 < held[0] < first < last < held[-1] < last + 0.6
    wider = bins[line_bins([line], torch.tensor([[29.5, 30.0], [30.0, 30.5]]), bins, 20.0, 5)]
    assert wider[0] == pytest.approx(held[0] - 0.1)
    assert wider[-1] == pytest.approx(held[-1] + 0.1)
    assert not line_bins([], torch.ones(1, 2), bins, 20.0).any()


def test_bins_left_out_do_not_change_an_estimate():
    model = model_at()
    observer = model.settings.observer(model.generator)
    mean = observer.expected(torch.tensor([[0.8, 0.7, 1.1, 0.9, 1.05]], dtype=torch.float64))
    spectra = CrossSpectra(mean.auto[0], mean.cross[0], mean.n_averages)
    bins = (observer.frequencies_hz > 6.0) & (observer.frequencies_hz < 6.6)
    inner = (observer.frequencies_hz > 6.15) & (observer.frequencies_hz < 6.45)
    # one wheelset is excited, not both: what the frame feels is not what the generator says
    auto = torch.where(inner, spectra.auto * torch.tensor([[100.0], [30.0], [30.0]]), spectra.auto)
    cross = torch.where(
        inner, spectra.cross * torch.tensor([[40.0], [60.0], [30.0]]), spectra.cross
    )
    disturbed = replace(spectra, auto=auto, cross=cross)
    clean, left_out, kept = (
        estimate_with_noise(model, one, 0.9, left_out=out)[0].values[0]
        for one, out in ((spectra, None), (disturbed, bins), (disturbed, None))
    )
    np.testing.assert_allclose(left_out, clean, rtol=0.005)
    assert np.abs(kept / clean - 1).max() > 0.02
