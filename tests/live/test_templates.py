"""A manifest that suspnet init wrote serves the monitor as it serves suspnet-evaluate."""

import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from cli_runner import typed
from trip_fixtures import RATES_HZ, model_at, signal, small_fleet

from suspnet.cli import init
from suspnet.estimation.trip_settings import TripSettings
from suspnet.live.sections import LiveSettings
from suspnet.live.suspension import read_suspensions
from suspnet.recordings.errors import TripError
from suspnet.recordings.manifest import CHANNELS
from suspnet.trips.fleet import FleetSettings
from suspnet.trips.manifest_template import BLANK

SETTINGS = FleetSettings(TripSettings())
UNITS = {"g": 9.80665, "m/s^2": 1.0, "mg": 9.80665e-3}


@pytest.fixture(scope="module")
def fleet():
    return small_fleet()


def templated(folder, manifest, how):
    """Write a trip's samples as a logger does, and complete the template of these files."""
    files = []
    for name, rate_hz, (unit, size) in zip(CHANNELS, RATES_HZ, UNITS.items(), strict=True):
        values = signal(manifest, name) / size
        stated = {b"unit": unit.encode()} | ({b"rate_hz": b"%g" % rate_hz} if how == "file" else {})
        fields, columns = [pa.field(name, pa.float64(), metadata=stated)], [values]
        if how == "times":
            fields.insert(0, pa.field("t", pa.float64()))
            columns.insert(0, np.arange(len(values)) / (rate_hz * 0.9998))
        files.append(folder / f"{name}.parquet")
        table = pa.table(columns, schema=pa.schema(fields))
        pq.write_table(table, files[-1], use_dictionary=False)
    done = typed(init, *files, "-o", folder / "trip.yaml", cwd=folder)
    assert done.returncode == 0, done.stderr
    path = folder / "trip.yaml"
    text = path.read_text(encoding="utf-8")
    filled = {
        "vehicle": model_at().vehicle.name,
        "suspension": "front",
        "mileage_km": "1000.0",
        "speed": "70.0",
        "side": "left",
    }
    for key, value in filled.items():
        text = re.sub(rf"^{key}:.*$", f"{key}: {value}", text, flags=re.MULTILINE)
    assert f": {BLANK}" not in text
    path.write_text(text, encoding="utf-8")
    return path


def test_range_without_a_unit_is_the_only_thing_that_is_missing(tmp_path, fleet):
    path = templated(tmp_path, fleet[0], "file")
    path.write_text(path.read_text().replace('column: "body"', 'column: "body", range: 50'))
    with pytest.raises(TripError, match=r"'body' has a `range`; write its `unit` to have it read"):
        read_suspensions(tmp_path, [model_at()], SETTINGS, LiveSettings())
