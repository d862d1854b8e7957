"""One trip in every format and dialect: the same estimate."""

from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml
from recording_files import write_csv, write_hdf5, write_mat, write_mdf, write_tdms, write_uff
from scipy.io import savemat, wavfile
from trip_fixtures import RATES_HZ, recalled_trip, signal

from suspnet.estimation.trip_settings import TripSettings
from suspnet.recordings.manifest import CHANNELS
from suspnet.recordings.manifest_files import read_manifest
from suspnet.recordings.recording import load_recording
from suspnet.trips.trip import evaluate_trip

RATES = dict(zip(CHANNELS, RATES_HZ, strict=True))
START = datetime(2015, 8, 3, 8, tzinfo=timezone(timedelta(hours=2)))
EPOCH_S = START.timestamp()
SECONDS = 70.0


@pytest.fixture(scope="module")
def expected(manifests, model):
    return recalled_trip(manifests[0], [model], TripSettings())


def stamps(n: int, rate_hz: float) -> list[str]:
    """Return ISO 8601 time stamps, with a decimal comma."""
    return [
        (START + timedelta(seconds=i / rate_hz))
        .isoformat(timespec="microseconds")
        .replace(".", ",")
        for i in range(n)
    ]


def german(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    """Semicolons, decimal commas, UTF-16, lines about the recording, units, local time stamps."""
    unit = "km/h" if path.stem == "speed" else "m/s²"
    values = values * 3.6 if unit == "km/h" else values
    rows = [
        f"{at};{value!r};".replace(".", ",")
        for at, value in zip(stamps(len(values), rate_hz), values.tolist(), strict=True)
    ]
    head = [
        "Messung;Drehgestell 1",
        "Prüfer;7",
        "",
        "Abtastrate [Hz];1.000,0",
        "Zeit;a;",
        f";{unit};",
    ]
    path.write_text("\r\n".join([*head, *rows]), encoding="utf-16")
    return {"column": "a", "time": "Zeit"}


def tabs(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    """Tabs, a byte-order mark, times in milliseconds since 1970."""
    at = 1e3 * (EPOCH_S + np.arange(len(values)) / rate_hz)
    rows = [f"{t!r}\t{v!r}" for t, v in zip(at.tolist(), values.tolist(), strict=True)]
    path.write_text("\n".join(["time\tvalue", *rows]), encoding="utf-8-sig")
    return {"column": "value", "time": "time"}


def blanks(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    """Blanks, a comment, no names."""
    rows = [f"  {i / rate_hz!r}   {value!r} " for i, value in enumerate(values.tolist())]
    path.write_text("\n".join(["% made on 3 August", *rows]), encoding="latin-1")
    return {"column": "column_2", "time": "column_1", "csv": {"header_line": 0}}


def commas(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    write_csv(path, {"a": values})
    return {"column": "a", "rate_hz": rate_hz}


def parquet(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    pq.write_table(pa.table({"a": values}), path, use_dictionary=False)
    return {"rate_hz": rate_hz}


def zoned(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    at = np.datetime64("2015-08-03T06:00:00", "ns")
    steps = np.round(np.arange(len(values)) * 1e9 / rate_hz).astype("timedelta64[ns]")
    times = pa.array(at + steps, pa.timestamp("ns", "Europe/Berlin"))
    pq.write_table(pa.table({"t": times, "a": values}), path, use_dictionary=False)
    return {}


def mat(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    write_mat(path, {"a": values})
    return {"rate_hz": rate_hz}


def struct(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    unit = "m/s" if path.stem == "speed" else "m/s^2"
    savemat(path, {"trip": {"data": values, "fs": rate_hz, "unit": unit}})
    return {"column": "trip.data"}


def hdf5(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    unit = "m/s" if path.stem == "speed" else "m/s2"
    write_hdf5(path, {"a": values}, rate_hz=rate_hz, unit=unit)
    return {}


def matrix(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["all"] = np.stack([np.zeros(len(values)), values], axis=1)
    return {"column": "all[1]", "rate_hz": rate_hz}


def tdms(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    unit = "m/s" if path.stem == "speed" else "m/s^2"
    start = START.astimezone(UTC).replace(tzinfo=None)
    write_tdms(path, {"a": values}, rate_hz=rate_hz, unit=unit, start=start)
    return {}


def mdf(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    unit = "m/s" if path.stem == "speed" else "m/s²"
    write_mdf(path, {"a": values}, rate_hz=rate_hz, unit=unit, start=START)
    return {}


def uff(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    unit = "m/s" if path.stem == "speed" else "m/s^2"
    write_uff(path, {"a": values}, rate_hz=rate_hz, unit=unit)
    return {}


def wav(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    wavfile.write(path, int(rate_hz), values.astype(np.float32))
    return {"unit": "m/s" if path.stem == "speed" else "m/s2"}


def integers(path: Path, values: np.ndarray, rate_hz: float) -> dict:
    if path.stem == "speed":
        return wav(path, values, rate_hz)
    wavfile.write(path, int(rate_hz), np.round(values / 200 * 2**31).astype(np.int32))
    return {"unit": "m/s2", "range": 200.0}


WAYS = {
    commas: ".csv", german: ".csv", tabs: ".txt", blanks: ".asc", zoned: ".parquet", mat: ".mat",
    struct: ".mat", hdf5: ".h5", matrix: ".hdf5", tdms: ".tdms", mdf: ".mf4", uff: ".uff",
    wav: ".wav", integers: ".wav",
}  # fmt: skip


def rewritten(manifest: Path, folder: Path, way, suffix: str, seconds: float = np.inf) -> Path:
    """Write a trip in another format; the manifest says only what the files do not.

    With `seconds`, only the start of it is written.
    """
    content = yaml.safe_load(manifest.read_text())
    content.pop("start")
    sources = {name: content["channels"][name] for name in CHANNELS} | {"speed": content["speed"]}
    for name, source in sources.items():
        path = folder / f"{name}{suffix}"
        rate_hz = RATES.get(name, 1.0)
        values = signal(manifest, name).astype(np.float64)[: int(min(seconds, 1e6) * rate_hz)]
        said = way(path, values, rate_hz)
        if way in (commas, tabs, blanks, mat, matrix, parquet, zoned):
            said["unit"] = source["unit"]
        source.clear()
        source.update({"file": path.name} | said)
    path = folder / "trip_001.yaml"
    path.write_text(yaml.safe_dump(content))
    return path


def slow_but(*ways):
    """Return all ways, of which some are tested by default."""
    return [
        pytest.param(way, marks=[pytest.mark.slow] * (way not in ways), id=way.__name__)
        for way in WAYS
    ]


@pytest.fixture(scope="module")
def start(manifests, tmp_path_factory):
    """The start of a trip."""
    folder = tmp_path_factory.mktemp("as_it_was")
    path = rewritten(manifests[0], folder, parquet, ".parquet", SECONDS)
    return load_recording(read_manifest(path), 50.0)


@pytest.mark.parametrize("way", slow_but(german, tabs, zoned, struct, hdf5, tdms, mdf, uff, wav))
def test_every_format_gives_the_same_recording(manifests, start, tmp_path, way):
    """The start of a trip in all formats; the estimate below hangs on nothing else."""
    path = rewritten(manifests[0], tmp_path, way, WAYS[way], SECONDS)
    found, expected = load_recording(read_manifest(path), 50.0), start
    assert found.usable.all()
    assert found.signals.shape == expected.signals.shape
    size = np.abs(expected.signals).max()
    np.testing.assert_allclose(found.signals, expected.signals, rtol=0, atol=1e-5 * size)
    np.testing.assert_allclose(found.speed_m_per_s, expected.speed_m_per_s, rtol=1e-6)
    assert ("delimiter" in found.words) == (WAYS[way] in (".csv", ".txt", ".asc"))


@pytest.mark.parametrize("way", slow_but(struct))
def test_every_format_gives_the_same_estimate(manifests, model, expected, tmp_path, way):
    path = rewritten(manifests[0], tmp_path, way, WAYS[way])
    result = evaluate_trip(path, [model], TripSettings())
    assert (result.status, result.reason) == ("ok", "")
    for name, value in expected.estimates.items():
        assert result.estimates[name] == pytest.approx(value, rel=1e-6)
    assert result.quality.segments_used == expected.quality.segments_used
    assert ("delimiter" in result.quality.read_as) == (WAYS[way] in (".csv", ".txt", ".asc"))
