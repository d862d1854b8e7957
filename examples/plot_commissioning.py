"""
Commissioning a vehicle that differs from its drawing
=====================================================

No vehicle is exactly its drawing: springs are stiffer, bushings softer, wheelbases a little off. A
model trained on the drawing takes such differences for wear. Commissioning finds from a few
healthy trips what the vehicle is. This example simulates a vehicle whose numbers are scattered
about its drawing, commissions it on three healthy trips, and reads a worn trip with it.
"""

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

from suspnet import (
    EstimateSettings,
    TripSettings,
    VerticalVehicle,
    bogie_trip,
    commission_bogie,
    fit_parts,
    load_recording,
    read_healthy,
    read_manifest,
    read_vehicles,
)
from suspnet.trains.simulation import Fleet, Scenario, Simulation, write_fleet

plt.style.use("tableau-colorblind10")
folder = TemporaryDirectory()
vehicle = read_vehicles()["am96"]

# %%
# A foreign vehicle
# -----------------
# ``scatter=1`` draws its numbers from the priors: what public vehicle models disagree about. Three
# healthy trips come first; on the fourth the primary spring has lost 15 % and the secondary damper
# 20 %.

RATES_HZ, MINUTES, N_HEALTHY = {"axle_box": 500.0, "bogie": 250.0, "body": 250.0}, 6.0, 3
WORN = {"k_p": 0.85, "c_s": 0.8}
fleet = Fleet(
    n_trips=N_HEALTHY + 1,
    last_mileage_km=400.0,
    minutes=MINUTES,
    sensors={channel: {"rate_hz": rate} for channel, rate in RATES_HZ.items()},
)
wear = {name: {"from_km": 300.0, "to_km": 400.0, "ratio": ratio} for name, ratio in WORN.items()}
drawing = VerticalVehicle(vehicle, speed_m_per_s=70.0, parts=("bushings",))
trips = Path(folder.name) / "trips"
*healthy_trips, worn_trip = write_fleet(
    trips, Simulation(fleet, Scenario("example", wear), drawing, seed=3, scatter=1.0)
)

# %%
# What the healthy trips show
# ---------------------------
# The prior says how far each number may lie from nominal, the posterior what is left of that; both
# are given by one standard deviation on either side.

settings = EstimateSettings(minutes=MINUTES, rates_hz=tuple(RATES_HZ.values())).bound(vehicle)
healthy = read_healthy(trips, drawing, settings, TripSettings(), n_first=N_HEALTHY)
bogie = commission_bogie(healthy.vehicle, healthy.of_parts)
print(f"misfit {bogie.misfit:.2f} (1: all that is seen is explained)")

numbers = json.loads((trips / "truth.json").read_text())["numbers"]
print(f"{'over the drawing':20} truth {'prior':>13} {'posterior':>13}")
ends = []
before, after = healthy.vehicle.distribution, bogie.generator.distribution
names = [name for name in after.names if name in numbers and name in before.names]
medians = [after.median[after.names.index(name)] for name in names]
for name in names:
    spans = [
        tuple(belief.quantile(n)[belief.names.index(name)] for n in (-1.0, 1.0))
        for belief in (before, after)
    ]
    ends.append(spans)
    prior, posterior = (f"{low:.2f} to {high:.2f}" for low, high in spans)
    print(f"{name:20} {numbers[name]['ratio']:5.2f} {prior:>13} {posterior:>13}")

figure, axis = plt.subplots(figsize=(5, 4.5), layout="constrained")
places = np.arange(len(ends))[::-1]
low, high = np.array([prior for prior, _ in ends]).T
axis.hlines(places, low, high, lw=9, color="C2", label="prior, ± 1 deviation")
axis.plot(medians, places, "o", ms=11, mfc="none", mew=2, label="posterior")
true_ratios = [numbers[name]["ratio"] for name in names]
axis.plot(true_ratios, places, "kx", ms=7, mew=2, label="truth")
axis.set_yticks(places, labels=[name.replace("_", " ") for name in names])
axis.set(xscale="log", xlabel="relative to the drawing", ylabel="number of the vehicle")
axis.set_xticks([0.2, 0.5, 1, 2], labels=["0.2", "0.5", "1", "2"])
axis.minorticks_off()
axis.grid(alpha=0.3, axis="x")
figure.legend(loc="outside upper center", ncols=3, fontsize="small")
plt.show()

# %%
# The worn trip
# -------------
# The commissioned vehicle itself reads the trip: one ratio of all springs or dampers of a kind,
# relative to what the healthy trips showed.

trip = bogie_trip(load_recording(read_manifest(worn_trip)), bogie.generator)
reading = fit_parts(bogie, trip).as_estimate()
kinds = list(reading.names[:4])
truth = np.array([WORN.get(name, 1.0) for name in kinds])
print("commissioned  truth  estimate")
for j, name in enumerate(kinds):
    print(f"{name:13} {truth[j]:5.2f} {reading.values[0, j]:9.3f}")
figure, axis = plt.subplots(figsize=(5, 4), layout="constrained")
middle, low, high = (part[0, :4] for part in (reading.values, reading.low, reading.high))
reach = [middle - low, high - middle]
axis.errorbar(np.arange(4), middle, reach, fmt="o", capsize=6, label="commissioned")
axis.plot(np.arange(4), truth, "kx", ms=10, mew=2, label="truth")
axis.axhline(1.0, color="0.5", lw=0.8)
axis.set_xticks(np.arange(4), labels=[f"${name}$" for name in kinds])
axis.set(xlabel="parameter", ylabel="relative to healthy", title="The worn trip, 90 % intervals")
axis.grid(alpha=0.3, axis="y")
axis.legend()
plt.show()
folder.cleanup()

# %%
# What one sees, and what not
# ---------------------------
# Spring and damper are found, and what is healthy is called so. The vehicle differs from its
# drawing in numbers only. Of physics that the family of vehicles does not have, healthy trips show
# a misfit well above 1, which counts as noise. And healthy is what the first trips showed: a part
# that was worn before them is not found. More is on the page on :doc:`commissioning
# </commissioning>`.
