"""A trip whose sensor comes loose is estimated from its good part, or has one clear reason."""

import pytest
from trip_fixtures import OUTPUTS, RATES_HZ, changed, recalled_trip, signal

from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.records import NO_ESTIMATE, OK
from suspnet.recordings.manifest import CHANNELS
from suspnet.trips.check import CheckSettings, check_trip
from suspnet.trips.check_page import READY, TOO_LITTLE
from suspnet.trips.trip import evaluate_trip

RATE = dict(zip(CHANNELS, RATES_HZ, strict=True))
SETTINGS = TripSettings()


def loose(manifest, folder, channel, from_s):
    """Return a copy of a trip in which a sensor shows the last digit of its logger from a time."""
    values = signal(manifest, channel).astype(float)
    later = values[round(from_s * RATE[channel]) :]
    later[:] = 0.01 * values.std() * ((later * 1e6).round() % 3 - 1)
    return changed(manifest, folder, channel, {channel: values})


@pytest.mark.parametrize("channel", [pytest.param("axle_box", marks=pytest.mark.slow), "bogie"])
def test_good_part_is_estimated(manifests, model, tmp_path, channel):
    whole = recalled_trip(manifests[1], [model], SETTINGS)
    path = loose(manifests[1], tmp_path, channel, 200)
    part = evaluate_trip(path, [model], SETTINGS)
    assert part.status == whole.status == OK
    assert f"{channel}: loose from about " in part.quality.faults
    assert "jump" not in part.quality.faults
    assert part.flags == whole.flags == ""
    assert part.quality.n_averages == pytest.approx(whole.quality.n_averages * 190 / 300, rel=0.15)
    for name in OUTPUTS:
        low, high = part.interval(name)
        assert low < whole.estimates[name] < high
    checked = check_trip(path, CheckSettings({model.vehicle.name: model.vehicle}))
    assert checked.state == READY
    assert any(remark.startswith(f"{channel}: loose from about ") for remark in checked.remarks)


def test_too_little_before_is_one_reason(manifests, model, tmp_path):
    path = loose(manifests[1], tmp_path, "body", 100)
    part = evaluate_trip(path, [model], SETTINGS)
    assert part.status == NO_ESTIMATE
    assert "too little is free of faults: body: loose from about " in part.reason
    assert "jump" not in part.reason + part.quality.faults
    checked = check_trip(path, CheckSettings({model.vehicle.name: model.vehicle}))
    assert checked.state == TOO_LITTLE
