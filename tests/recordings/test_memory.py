"""A long recording is read in bounded memory."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest
import yaml

from suspnet.trains.recordings.manifest import CHANNELS

HOURS, RATE_HZ, MOST_GB = 6, 1000.0, 1.0
CODE = """
import re, sys
from pathlib import Path
import torch
from suspnet.curves.welch import Welch
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import load_recording
from suspnet.trains.spectra.segments import recording_segments
recording_segments(load_recording(read_manifest(Path(sys.argv[1]))), Welch())
# not ru_maxrss, which begins with that of the process that started this one
print(re.search("VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="asks Linux for the peak")
@pytest.mark.parametrize("suffix", ["parquet", "csv"])
def test_six_hours_take_less_than_a_gigabyte(tmp_path, suffix):
    rng = np.random.default_rng(0)
    n = round(HOURS * 3600 * RATE_HZ)
    piece = rng.standard_normal(n // 60)
    channels = {}
    for i, name in enumerate(CHANNELS):
        noise = rng.standard_normal(len(piece))
        values = np.tile((piece + i * noise).astype(np.float32), 60)
        table = pa.table({"t": np.arange(n) / RATE_HZ, "a": values})
        path = tmp_path / f"{name}.{suffix}"
        pq.write_table(table, path) if suffix == "parquet" else pa.csv.write_csv(table, path)
        channels[name] = {"file": path.name, "column": "a", "unit": "m/s2", "time": "t"}
    content = {"format": "suspnet-trip-1", "vehicle": "am96", "suspension": "x", "mileage_km": 1}
    (tmp_path / "trip.yaml").write_text(
        yaml.safe_dump(content | {"speed": 70, "channels": channels})
    )
    command = [sys.executable, "-c", CODE, str(tmp_path / "trip.yaml")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    peak_gb = int(done.stdout) * 1024 / 1e9
    print(f"{suffix}: {peak_gb:.3f} GB")
    assert peak_gb < MOST_GB
