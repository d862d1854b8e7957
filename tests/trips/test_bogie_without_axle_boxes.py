"""A bogie without sensors on axle boxes: its parts are read, both sides as equal are not."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch
import yaml
from commissioned_example import NO_SCATTER
from vehicles import AM96

from suspnet.curves.estimates import EstimateSettings
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.fits.commissioning import as_bogie
from suspnet.trains.identification.healthy_trips import read_healthy
from suspnet.trains.jobs.check import CheckSettings, check_trip
from suspnet.trains.jobs.commissioning import prior_of
from suspnet.trains.pages.check_page import READY, TOO_LITTLE, summary
from suspnet.trains.pages.commissioning_page import write_outcome
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest_files import ManifestFile
from suspnet.trains.trips import sensor_checks
from suspnet.vehicle import VerticalVehicle

RATE_HZ = 100.0
SETTINGS = EstimateSettings().bound(AM96)
GENERATOR = VerticalVehicle(AM96)


def trips(folder, minutes=16.0, direction="forward"):
    """Write three trips of noise on four sensors, and return their manifests."""
    sides, rng = ("left", "right"), np.random.default_rng(0)
    columns = [f"{place} {side}" for place in ("bogie", "body") for side in sides]
    n = round(60 * minutes * RATE_HZ)
    pq.write_table(pa.table({c: rng.standard_normal(n) for c in columns}), folder / "all.parquet")
    channels = {
        place: [
            {"file": "all.parquet", "column": f"{place} {side}", "unit": "m/s2", "side": side}
            | {"rate_hz": RATE_HZ}
            for side in sides
        ]
        for place in ("bogie", "body")
    }
    paths = []
    for i in range(3):
        content = {"format": "suspnet-trip-1", "vehicle": "am96", "suspension": "A", "speed": 70.0}
        content |= {"mileage_km": 1000.0 * (i + 1), "channels": channels}
        paths.append(folder / f"trip_{i}.yaml")
        paths[-1].write_text(
            yaml.safe_dump(content | ({"direction": direction} if direction else {}))
        )
    return paths


def healthy(folder):
    return read_healthy(folder, GENERATOR, SETTINGS, TripSettings())


@pytest.mark.slow
def test_its_vehicle_of_equal_sides_is_that_of_its_parts(tmp_path):
    trips(tmp_path)
    found = healthy(tmp_path)
    assert found.absent
    assert {trip.direction for trip in found.of_parts} == {"forward"}
    assert found.speeds_m_per_s == pytest.approx([70.0] * 3)
    masses = np.array([1.0, 1.1, 1.2])
    bogie = CommissionedBogie(found.vehicle, torch.ones(4), masses, 1.05, True, NO_SCATTER)
    outcome = as_bogie(prior_of(GENERATOR, found), bogie)
    assert outcome.bogie == bogie
    of_parts, equal = bogie.generator.distribution, outcome.posterior
    for name, mean, deviation in zip(equal.names, equal.mean, equal.deviations, strict=True):
        if name in of_parts.names:
            i = of_parts.names.index(name)
            assert (mean, deviation) == (of_parts.mean[i], of_parts.deviations[i])
        else:
            i = outcome.prior.names.index(name)
            assert (mean, deviation) == (outcome.prior.mean[i], outcome.prior.deviations[i])
    write_outcome(tmp_path, found, outcome)
    page = (tmp_path / "commissioning.html").read_text()
    assert "bogie frame of axle 1, left" in page
    assert (tmp_path / "figures" / "commissioning_responses.png").exists()


def test_what_it_needs_is_said(tmp_path):
    trips(tmp_path, direction=None)
    with pytest.raises(TripError, match="without a sensor on axle_box the phases do not show"):
        healthy(tmp_path)


@pytest.mark.parametrize(
    ("minutes", "direction", "state"),
    [(16.0, "forward", READY), (16.0, None, TOO_LITTLE), (1.9, "forward", TOO_LITTLE)],
)
def test_check_says_whether_its_parts_can_be_read(tmp_path, monkeypatch, minutes, direction, state):
    for name in ("check_order", "check_end"):  # noise has none
        monkeypatch.setattr(sensor_checks, name, lambda vehicle, trip, **_: None)
    path = trips(tmp_path, minutes, direction)[0]
    found = check_trip(path, CheckSettings({"am96": AM96}))
    assert (found.state, found.shows_parts) == (state, state == READY)
    assert any("give `direction" in one for one in found.remarks) == (direction is None)
    assert any("for 4 sensors, stretches" in one for one in found.remarks) == (minutes < 5)
    if state == READY:
        assert found.parts[0].speed_m_per_s == pytest.approx(70.0)
        assert "nan" not in summary([found])
    assert ManifestFile(path).trip.channels.keys() == {"bogie", "body"}
