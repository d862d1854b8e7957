"""Damaged manifests and data files: one clear error each, and quickly; run with -m slow for all."""

import random
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from recording_files import WRITERS

from suspnet.trains.recordings import reader_process
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_file, read_columns
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.recordings.manifest_files import ManifestFile, read_manifest

VALUES = (
    *("no", "0777", "12:30:45", "x", "-1", "1e999", "[1]", "{}", "null", "true", ".nan", "'", "&a"),
    *("*a", "!!int 1", "2015-08-03", '"\\x00"', "9" * 400, "é", "- ", "a: b", "<<", "1_0", "\t"),
)
FEW, MANY = 100, 10_000
SECONDS = 20.0
"""Longest time for MANY manifests."""


def trip(folder: Path) -> str:
    for name in (*CHANNELS, "speed"):
        (folder / f"{name}.csv").write_text("t,a\n0,1\n")
    one = {"column": "a", "unit": "m/s2", "rate_hz": 1000.0, "time": "t", "time_unit": "s"}
    one |= {"csv": {"delimiter": ",", "decimal": ".", "header_line": 1, "encoding": "utf-8"}}
    content = {"format": "suspnet-trip-1", "vehicle": "am96", "suspension": "x", "mileage_km": 1.0}
    content |= {"start": "2015-08-03T08:00:00", "speed": one | {"file": "speed.csv", "unit": "m/s"}}
    content["channels"] = {name: one | {"file": f"{name}.csv"} for name in CHANNELS}
    return yaml.safe_dump(content, sort_keys=False)


def broken(text: str, draw: random.Random) -> bytes:
    """Return a manifest with a line changed, doubled, moved or cut, or with other bytes."""
    lines = text.splitlines()
    for _ in range(draw.randint(1, 3)):
        i = draw.randrange(len(lines))
        way = draw.randrange(6)
        if way == 0:
            lines.insert(i, draw.choice(lines))
        elif way == 1:
            lines[i] = f"{lines[i].split(':')[0]}: {draw.choice(VALUES)}"
        elif way == 2:
            lines[i] = draw.choice(VALUES) + lines[i]
        elif way == 3:
            lines[i] = lines[i][: draw.randrange(len(lines[i]) + 1)]
        elif way == 4 and len(lines) > 1:
            del lines[i]
        else:
            raw = bytearray("\n".join(lines).encode())
            raw[draw.randrange(len(raw))] = draw.randrange(256)
            return bytes(raw)
    return "\n".join(lines).encode()


@pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])
def test_broken_manifests_have_one_line_each_and_are_quick(tmp_path, count):
    text, draw, n_refused, seconds = trip(tmp_path), random.Random(0), 0, 0.0
    path = tmp_path / "trip.yaml"
    for _ in range(count):
        path.write_bytes(broken(text, draw))
        start = time.process_time()
        try:
            read_manifest(path)
        except TripError as error:
            n_refused += 1
            assert "trip.yaml" in str(error)  # noqa: PT017
            assert "\n" not in str(error)  # noqa: PT017
        _ = ManifestFile(path).place
        seconds += time.process_time() - start
    assert n_refused > count / 2
    if count == MANY:
        print(f"{count} manifests, {n_refused} refused, {seconds:.1f} s")
        assert seconds < SECONDS


@contextmanager
def suppress_named(path: Path):
    """Suppress an error that names a file."""
    try:
        yield
    except TripError as error:
        assert path.name in str(error)  # noqa: PT017


@pytest.mark.parametrize("count", [3, pytest.param(500, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "suffix",
    [
        pytest.param(suffix, marks=[pytest.mark.slow] * (suffix not in (".mat", ".mf4")))
        for suffix in WRITERS
    ],
)
def test_damaged_files_are_read_or_refused(tmp_path, monkeypatch, suffix, count):
    monkeypatch.setenv(reader_process.LIMIT, "20")
    draw, path = random.Random(suffix), tmp_path / f"data{suffix}"
    columns = {"t": np.arange(50.0), "a": np.arange(50.0)}
    WRITERS[suffix](path, columns, rate_hz=100.0, unit="g")
    whole = path.read_bytes()
    for _ in range(count):
        content = bytearray(whole)
        if draw.random() < 0.2:
            content = content[: draw.randrange(len(content))]
        for _ in range(draw.randint(1, 8) if content else 0):
            content[draw.randrange(len(content))] = draw.randrange(256)
        path.write_bytes(content)
        with suppress_named(path):
            with open_file(path) as file:
                for column in file.columns:
                    with suppress_named(path):
                        list(read_columns(path, file, [column.name]))
