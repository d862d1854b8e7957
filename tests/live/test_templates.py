"""A manifest that suspnet init wrote serves the monitor as it serves suspnet-evaluate."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from cli_runner import typed
from trip_fixtures import RATES_HZ, model_at, signal, small_fleet

from suspnet.cli import init
from suspnet.depot.live.sections import LiveSettings
from suspnet.depot.live.suspension import read_suspensions
from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.jobs.fleet import FleetSettings
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import CHANNELS

SETTINGS = FleetSettings(TripSettings())


def test_range_without_a_unit_is_the_only_thing_that_is_missing(tmp_path):
    manifest, files = small_fleet()[0], []
    for name, rate_hz in zip(CHANNELS, RATES_HZ, strict=True):
        stated = {b"unit": b"mg", b"rate_hz": b"%g" % rate_hz}
        schema = pa.schema([pa.field(name, pa.float64(), metadata=stated)])
        files.append(tmp_path / f"{name}.parquet")
        pq.write_table(pa.table([signal(manifest, name)], schema=schema), files[-1])
    texts = {"vehicle": model_at().vehicle.name, "suspension": "front", "side": "left"}
    said = [f"{k}={v}" for k, v in (texts | {"mileage_km": 1000, "speed": 70}).items()]
    done = typed(init, *files, *said, "-o", tmp_path / "trip.yaml", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "trip.yaml").read_text(encoding="utf-8")
    text = text.replace('column: "body"', 'column: "body", range: 50')
    (tmp_path / "trip.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(TripError, match=r"'body' has a `range`; write its `unit` to have it read"):
        read_suspensions(tmp_path, [model_at()], SETTINGS, LiveSettings())
