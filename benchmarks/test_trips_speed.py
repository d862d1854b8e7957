"""One hour of recording to an estimate, beside pipelines that stop at the transfer functions.

pytest benchmarks --benchmark-only
"""

import json
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from protocols import shipped_protocol
from scipy.signal import csd, resample_poly, welch
from trip_fixtures import AM96, SPEED, NoLog, write_trips

from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.problem import Problem
from suspnet.estimation.checkpoint import save_model
from suspnet.estimation.trip_settings import TripSettings
from suspnet.learning import MSVR
from suspnet.runs.fit import fit
from suspnet.trains.trips.trip import evaluate_trip
from suspnet.vehicle import VerticalVehicle

MINUTES = 60.0
RATES = {"axle_box": 5000, "bogie": 2000, "body": 2000}
RATE, SEGMENT = 100, 2000
GROUP = "one hour of three channels, 5000/2000/2000 Hz, Parquet"
MEMORY = r"""
import json, re, sys
from pathlib import Path
import torch
from suspnet.estimation.checkpoint import load_model
from suspnet.trains.trips.trip import TripSettings, evaluate_trip

def peak_kib():
    # not ru_maxrss, which starts from that of the process that started this one
    return int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1])

torch.set_num_threads(1)
model = load_model(Path(sys.argv[1]))
before = peak_kib()
result = evaluate_trip(Path(sys.argv[2]), [model], TripSettings())
print(json.dumps({"status": result.status, "before": before, "after": peak_kib()}))
"""


@pytest.fixture(scope="module")
def hour(tmp_path_factory):
    """The manifest of a trip with the sensors of Table II."""
    folder = tmp_path_factory.mktemp("hour")
    sensors = {name: {"rate_hz": float(rate)} for name, rate in RATES.items()}
    return write_trips(folder, minutes=MINUTES, sensors=sensors)[0]


@pytest.fixture(scope="module")
def model():
    settings = EstimateSettings(1500, 100, SPEED, minutes=MINUTES)
    generator = VerticalVehicle(AM96, speed_m_per_s=SPEED)
    problem = Problem(generator, shipped_protocol("trips").task("all"), settings, progress=False)
    return fit(problem, MSVR(1e4, 8.0, 1e-3, "nystroem", 512), NoLog())


def decimated(manifest):
    """Return the channels at 100 Hz, read and resampled as a user would."""
    folder = manifest.with_suffix("")
    signals = []
    for name, rate in RATES.items():
        values = pq.read_table(folder / f"{name}.parquet")["acceleration"].to_numpy()
        signals.append(resample_poly(values, 1, rate // RATE))
    return signals


def scipy_h1(manifest):
    box, bogie, body = decimated(manifest)
    found = []
    for x, y in ((box, bogie), (bogie, body)):
        options = {"fs": RATE, "nperseg": SEGMENT, "noverlap": SEGMENT // 2}
        frequencies, power = welch(x, **options)
        found.append(csd(x, y, **options)[1] / power)
    return frequencies, np.array(found)


def pyfrf_h1(manifest, frf):
    box, bogie, body = decimated(manifest)
    found = []
    for x, y in ((box, bogie), (bogie, body)):
        one = frf(
            RATE,
            exc=x,
            resp=y,
            exc_type="d",  # as both are accelerations, nothing is to be converted
            resp_type="d",
            window="hann",
            fft_len=SEGMENT,
            nperseg=SEGMENT,
            noverlap=SEGMENT // 2,
        )
        found.append(one.get_H1()[0, 0])
    return one.get_f_axis(), np.array(found)


def check(frequencies, responses, result):
    """The same curves came out; H1 is low by the axle box's noise."""
    wanted = result.curves
    place = np.searchsorted(frequencies, wanted.frequencies_hz - 1e-6)
    np.testing.assert_allclose(frequencies[place], wanted.frequencies_hz)
    ratio = np.abs(responses[:, place]) / np.abs(wanted.responses)
    np.testing.assert_allclose(np.median(ratio, axis=1), 1, atol=0.1)


@pytest.mark.benchmark(group=GROUP)
def test_suspnet_to_the_estimate(benchmark, hour, model, tmp_path):
    run = (evaluate_trip, (hour, [model], TripSettings()))
    result = benchmark.pedantic(*run, rounds=5, warmup_rounds=1)
    assert result.status == "ok", result.reason
    assert result.estimates["k_s"] == pytest.approx(1, rel=0.05)
    save_model(tmp_path, model)
    ended = subprocess.run(
        [sys.executable, "-c", MEMORY, str(tmp_path), str(hour)],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
        check=True,
    )
    memory = json.loads(ended.stdout)
    assert memory["status"] == "ok"
    benchmark.extra_info["peak RSS, MiB"] = round(memory["after"] / 1024)
    benchmark.extra_info["of it before the trip, MiB"] = round(memory["before"] / 1024)
    print(dict(benchmark.extra_info))


@pytest.mark.benchmark(group=GROUP)
def test_scipy_to_transfer_functions(benchmark, hour, model):
    found = benchmark.pedantic(scipy_h1, (hour,), rounds=5, warmup_rounds=1)
    check(*found, evaluate_trip(hour, [model], TripSettings()))


@pytest.mark.benchmark(group=GROUP)
def test_pyfrf_to_transfer_functions(benchmark, hour, model):
    frf = pytest.importorskip("pyFRF").FRF
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pyFRF divides by zero at 0 Hz
        found = benchmark.pedantic(pyfrf_h1, (hour, frf), rounds=5, warmup_rounds=1)
    check(*found, evaluate_trip(hour, [model], TripSettings()))
