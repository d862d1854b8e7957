"""One trip in every format and dialect: the same estimate."""

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from recording_files import write_mat, write_mdf, write_tdms
from scipy.io import savemat
from trip_fixtures import RATES_HZ, changed, recalled_trip, signal

from suspnet.estimation.trip_settings import TripSettings
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import load_recording
from suspnet.trains.trips.trip import evaluate_trip

RATES = dict(zip(CHANNELS, RATES_HZ, strict=True))
START = datetime(2015, 8, 3, 8, tzinfo=timezone(timedelta(hours=2)))
EPOCH_S = START.timestamp()
SECONDS = 70.0


def unit_of(path: Path, squared: str = "m/s2") -> str:
    return "m/s" if path.stem == "speed" else squared


def german(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    """Semicolons, decimal commas, UTF-16, lines about the recording, units, local time stamps."""
    unit = "km/h" if path.stem == "speed" else "m/s²"
    values = values * 3.6 if unit == "km/h" else values
    times = (START + timedelta(seconds=i / rate_hz) for i in range(len(values)))
    rows = [
        f"{at.isoformat(timespec='microseconds')};{value!r};".replace(".", ",")
        for at, value in zip(times, values.tolist(), strict=True)
    ]
    head = ["Messung;Drehgestell 1", "Prüfer;7", "", "Abtastrate [Hz];1.000,0", "Zeit;a;"]
    path.write_text("\r\n".join([*head, f";{unit};", *rows]), encoding="utf-16")
    return {"column": "a", "time": "Zeit"}


def tabs(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    """Tabs, a byte-order mark, times in milliseconds since 1970."""
    at = 1e3 * (EPOCH_S + np.arange(len(values)) / rate_hz)
    rows = [f"{t!r}\t{v!r}" for t, v in zip(at.tolist(), values.tolist(), strict=True)]
    path.write_text("\n".join(["time\tvalue", *rows]), encoding="utf-8-sig")
    return {"column": "value", "time": "time", "unit": unit_of(path)}


def blanks(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    """Blanks, a comment, no names."""
    rows = [f"  {i / rate_hz!r}   {value!r} " for i, value in enumerate(values.tolist())]
    path.write_text("\n".join(["% made on 3 August", *rows]), encoding="latin-1")
    names = {"column": "column_2", "time": "column_1", "csv": {"header_line": 0}}
    return names | {"unit": unit_of(path)}


def zoned(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    at = np.datetime64("2015-08-03T06:00:00", "ns")
    steps = np.round(np.arange(len(values)) * 1e9 / rate_hz).astype("timedelta64[ns]")
    times = pa.array(at + steps, pa.timestamp("ns", "Europe/Berlin"))
    pq.write_table(pa.table({"t": times, "a": values}), path, use_dictionary=False)
    return {"unit": unit_of(path)}


def mat(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    write_mat(path, {"a": values})
    return {"rate_hz": rate_hz, "unit": unit_of(path)}


def struct(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    savemat(path, {"trip": {"data": values, "fs": rate_hz, "unit": unit_of(path, "m/s^2")}})
    return {"column": "trip.data"}


def matrix(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    savemat(path, {"all": np.stack([np.zeros(len(values)), values], axis=1)})
    return {"column": "all[1]", "rate_hz": rate_hz, "unit": unit_of(path)}


def tdms(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    start = START.astimezone(UTC).replace(tzinfo=None)
    write_tdms(path, {"a": values}, rate_hz=rate_hz, unit=unit_of(path, "m/s^2"), start=start)
    return {}


def mdf(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    write_mdf(path, {"a": values}, rate_hz=rate_hz, unit=unit_of(path, "m/s²"), start=START)
    return {}


WAYS = {
    **{german: ".csv", tabs: ".txt", blanks: ".asc", zoned: ".parquet", mat: ".mat"},
    **{struct: ".mat", matrix: ".mat", tdms: ".tdms", mdf: ".mf4"},
}
SLOW = (blanks, mat, matrix)
"""Ways that differ little from another one."""


def rewritten(manifest: Path, folder: Path, way, seconds: float) -> Path:
    """Write the start of a trip in another format; the manifest says only what the files do not."""
    content = yaml.safe_load(manifest.read_text())
    content.pop("start")
    sources = {name: content["channels"][name] for name in CHANNELS} | {"speed": content["speed"]}
    for name, source in sources.items():
        path = folder / f"{name}{WAYS[way]}"
        rate_hz = RATES.get(name, 1.0)
        values = signal(manifest, name).astype(np.float64)[: int(seconds * rate_hz)]
        stated = way(path, values, rate_hz)
        source.clear()
        source.update({"file": path.name} | stated)
    path = folder / "trip_001.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.fixture(scope="module")
def start(manifests, tmp_path_factory):
    """The start of a trip as it is simulated."""
    names = (*CHANNELS, "speed")
    values = {n: signal(manifests[0], n)[: int(SECONDS * RATES.get(n, 1.0))] for n in names}
    path = changed(manifests[0], tmp_path_factory.mktemp("start"), signals=values)
    return load_recording(read_manifest(path), 50.0)


@pytest.mark.parametrize(
    "way",
    [
        pytest.param(way, marks=[pytest.mark.slow] if way in SLOW else [], id=way.__name__)
        for way in WAYS
    ],
)
def test_every_format_gives_the_same_recording(manifests, start, tmp_path, way):
    """The start of a trip in all formats; the estimate below depends on nothing else."""
    found = load_recording(read_manifest(rewritten(manifests[0], tmp_path, way, SECONDS)), 50.0)
    assert found.usable.all()
    assert found.signals.shape == start.signals.shape
    size = np.abs(start.signals).max()
    np.testing.assert_allclose(found.signals, start.signals, rtol=0, atol=1e-5 * size)
    np.testing.assert_allclose(found.speed_m_per_s, start.speed_m_per_s, rtol=1e-6)
    assert ("delimiter" in found.words) == (WAYS[way] in (".csv", ".txt", ".asc"))


def test_another_format_gives_the_same_estimate(manifests, model, tmp_path):
    expected = recalled_trip(manifests[0], [model], TripSettings())
    result = evaluate_trip(rewritten(manifests[0], tmp_path, struct, 1e4), [model], TripSettings())
    assert (result.status, result.reason) == ("ok", "")
    for name, value in expected.estimates.items():
        assert result.estimates[name] == pytest.approx(value, rel=1e-6)
    assert result.quality.segments_used == expected.quality.segments_used
