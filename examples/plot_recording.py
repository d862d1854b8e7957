"""
From a recording to stiffness and damping
=========================================

A trip is recorded by three accelerometers. This example simulates a short one of a worn
suspension, so that the truth is known, trains a model for the vehicle, and reads the recording
with it: each parameter relative to healthy, with an interval and a flag.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

from suspnet import (
    MSVR,
    EstimateSettings,
    Problem,
    VerticalVehicle,
    load_model,
    load_recording,
    read_manifest,
    read_protocol,
    read_vehicles,
    tfestimate,
    train,
)
from suspnet.trains.simulation import Fleet, Scenario, Simulation, write_fleet

plt.style.use("tableau-colorblind10")
folder = TemporaryDirectory()
vehicle = VerticalVehicle(read_vehicles()["am96"], speed_m_per_s=70.0)

# %%
# A recording
# -----------
# Six minutes at 70 m/s. The primary spring has lost 10 % and the secondary damper 25 %. Sensors
# have noise of 34 dB, and sampling rates below those of the paper, to be quick. Yours would be a
# manifest beside files of any logger instead.

RATES_HZ, MINUTES = {"axle_box": 500.0, "bogie": 250.0, "body": 250.0}, 6.0
WORN = {"k_p": 0.9, "c_s": 0.75}
fleet = Fleet(
    n_trips=1,
    last_mileage_km=200_000.0,
    minutes=MINUTES,
    sensors={channel: {"rate_hz": rate} for channel, rate in RATES_HZ.items()},
)
wear = {name: {"from_km": 0.0, "to_km": 100_000.0, "ratio": ratio} for name, ratio in WORN.items()}
scenario = Scenario("example", changes=wear, mass_low=1.1, mass_high=1.1)
(trip,) = write_fleet(Path(folder.name) / "trips", Simulation(fleet, scenario, vehicle, seed=1))
print(trip.read_text())

# %%
# What was recorded
# -----------------
# Ten seconds of the three channels, and the two frequency responses estimated from all of it. The
# third channel serves as an instrument, so that noise of a sensor does not bias the estimate.

recording = load_recording(read_manifest(trip), 100.0)
axle_box, bogie, body = recording.signals
responses = {
    "$G_p$": tfestimate(axle_box, bogie, recording.rate_hz, method="IV", instrument=body),
    "$G_s$": tfestimate(bogie, body, recording.rate_hz, method="IV", instrument=axle_box),
}

figure, axes = plt.subplots(4, 1, figsize=(5, 8), layout="constrained", height_ratios=[1, 1, 1, 3])
seconds = np.arange(1000) / recording.rate_hz
for axis, signal, name in zip(axes, recording.signals, ("axle box", "frame", "body"), strict=False):
    axis.plot(seconds, signal[3000:4000], lw=0.8)
    axis.set(ylabel=f"{name}\n[m/s²]")
    axis.grid(alpha=0.3)
    axis.tick_params(labelbottom=axis is axes[2])
axes[2].set_xlabel("time [s]")
for (name, found), line in zip(responses.items(), ("-", "--"), strict=True):
    axes[3].loglog(found.frequencies_hz, found.response.abs(), line, label=name)
axes[3].set(xlabel="frequency [Hz]", ylabel="magnitude", xlim=(0.4, 10), ylim=(3e-3, 10))
axes[3].set_xticks([0.5, 1, 2, 5, 10], labels=["0.5", "1", "2", "5", "10"])
axes[3].minorticks_off()
axes[3].grid(alpha=0.3)
axes[3].legend()
plt.show()

# %%
# A model for this vehicle
# ------------------------
# Training curves are what such a trip would show of 1,500 vehicles with springs, dampers and
# masses in a range about healthy; no recording takes part. On the command line this is
# ``suspnet-train experiment=trips``, with 20,000.

protocol = read_protocol("trips")
settings = EstimateSettings(
    n_train=1500,
    n_test=100,
    n_calibrate=500,
    minutes=MINUTES,
    rates_hz=tuple(RATES_HZ.values()),
)
problem = Problem(vehicle, protocol.task("all"), settings, seed=0)
method = MSVR(C=1e4, sigma=8.0, epsilon=1e-3, feature_map="nystroem", n_components=512)
metrics = train(problem, method, Path(folder.name) / "model", figures=False)
print("rms error on test curves:")
print({name: f"{value:.2g} %" for name, value in metrics["rms_percent"].items()})

# %%
# Its estimate
# ------------

model = load_model(Path(folder.name) / "model")
estimate = model.estimate(trip, level=0.9)
truth = np.array([WORN.get(name, 1.0) for name in estimate.names[:4]] + [1.1])
print("       true   estimate   90 % interval")
for name, true, value, low, high in zip(
    estimate.names, truth, estimate.values[0], estimate.low[0], estimate.high[0], strict=True
):
    print(f"{name:4} {true:6.2f} {value:10.3f}   {low:.3f} to {high:.3f}")
print("flags:", estimate.flags.reasons[0] or "none")

low, middle, high = (
    100 * (ends[0] / truth - 1) for ends in (estimate.low, estimate.values, estimate.high)
)
figure, axis = plt.subplots(figsize=(5, 3.5), layout="constrained")
places = np.arange(len(truth))
axis.errorbar(places, middle, yerr=[middle - low, high - middle], fmt="o", capsize=8, lw=2)
axis.axhline(0.0, color="black", ls="--", label="truth")
axis.set_xticks(places, labels=[f"${name}$" for name in estimate.names])
axis.set(xlabel="parameter", ylabel="off the truth [%]", title="One trip, 90 % intervals")
axis.grid(alpha=0.3, axis="y")
axis.legend()
plt.show()
folder.cleanup()

# %%
# What one sees, and what not
# ---------------------------
# From six minutes every parameter comes out within a percent, and the interval says how well: the
# damping of the primary suspension is the least certain. Were the five intervals of 90 %
# independent, four trips in ten would have one that misses.
#
# The vehicle that was simulated is exactly the one that the model was made from. No real one is:
# :ref:`commissioning <sphx_glr_gallery_plot_commissioning.py>` is for that.
