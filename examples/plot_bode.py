"""
What wear does to the Bode plot
===============================

A suspension filters what the track does to the wheels. Two frequency responses describe it: G_p
from the axle box to the bogie frame and G_s from the frame to the car body, both between
accelerations. This example draws them for a healthy vehicle, and then what is left of them when a
spring or a damper has lost 30 %.
"""

import matplotlib.pyplot as plt
import numpy as np
import torch

from suspnet import PARAMETERS, QuarterCar, findpeaks, read_vehicles

plt.style.use("tableau-colorblind10")
TICKS_HZ = [0.5, 1, 2, 5, 10, 20]
vehicle = read_vehicles()["am96"]
model = QuarterCar(vehicle)
frequencies_hz = torch.arange(0.3, 20.0, 0.01, dtype=torch.float64)
print(vehicle.source)

# %%
# The healthy vehicle
# -------------------
# Parameters are ratios to healthy throughout: k_p and c_p are stiffness and damping of the primary
# suspension, k_s and c_s of the secondary one, M_s is the car-body mass. A row of ones is healthy.

healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
responses = [response[0].numpy() for response in model.responses(healthy, frequencies_hz)]

figure, (upper, lower) = plt.subplots(2, 1, figsize=(5, 5), sharex=True, layout="constrained")
for response, name, line in zip(responses, ("$G_p$", "$G_s$"), ("-", "--"), strict=True):
    upper.semilogx(frequencies_hz, 20 * np.log10(np.abs(response)), line, label=name)
    lower.semilogx(frequencies_hz, np.degrees(np.unwrap(np.angle(response))), line, label=name)
upper.set(ylabel="magnitude [dB]", title="Healthy vehicle")
lower.set(xlabel="frequency [Hz]", ylabel="phase [degrees]")
for axis in (upper, lower):
    axis.grid(alpha=0.3)
    axis.legend()
    axis.set_xticks(TICKS_HZ, labels=map(str, TICKS_HZ))
    axis.minorticks_off()
plt.show()

# %%
# G_p has two peaks. In the lower one, near 1.3 Hz, body and frame move together; in the upper one,
# near 5 Hz, the frame bounces between its springs. G_s has one peak, that of the body on its
# springs.
#
# Wear
# ----
# One parameter after the other loses 30 %.

WORN = 0.7
changes_db = {}
for j, name in enumerate(PARAMETERS[:4]):
    ratios = healthy.clone()
    ratios[0, j] = WORN
    both = torch.cat([healthy, ratios])
    before, after = 20 * torch.log10(model.magnitudes(both, frequencies_hz))
    changes_db[name] = after - before

figure, axes = plt.subplots(2, 1, figsize=(5, 6), sharex=True, layout="constrained")
for axis, row, title in zip(axes, (0, 1), ("$G_p$", "$G_s$"), strict=True):
    for (name, change), line in zip(changes_db.items(), ("-", "--", "-.", ":"), strict=True):
        axis.semilogx(frequencies_hz, change[row], line, label=f"${name}$")
    axis.set(ylabel="change [dB]", title=f"{title} after a loss of 30 %")
    axis.grid(alpha=0.3)
    axis.set_xticks(TICKS_HZ, labels=map(str, TICKS_HZ))
    axis.minorticks_off()
axes[0].legend(ncols=2)
axes[1].set_xlabel("frequency [Hz]")
plt.show()

# %%
# G_s does not feel the primary suspension at all: the frame's motion is its input. G_p feels all
# four, but c_p by a few tenths of a decibel only: on this vehicle the secondary damper is six
# times as strong, and c_p is what every method estimates worst. The same in numbers, of the peak
# of G_s and the larger one of G_p:

print("30 % less of   G_p: peak at Hz   height     G_s: peak at Hz   height")
for name in ("nothing", *PARAMETERS[:4]):
    ratios = healthy.clone()
    if name in PARAMETERS:
        ratios[0, PARAMETERS.index(name)] = WORN
    peaks = findpeaks(model.magnitudes(ratios, frequencies_hz)[0], frequencies_hz)
    (f_p, f_s), (h_p, h_s) = peaks.position_hz.tolist(), peaks.height.tolist()
    print(f"{name:12} {f_p:17.2f} {h_p:8.2f} {f_s:19.2f} {h_s:8.2f}")

# %%
# What this does not show
# -----------------------
# A heavier body moves the peaks too, so a shifted peak alone says nothing about wear: G_s depends
# on k_s and c_s only through their quotient with the car-body mass. Both curves together tell them
# apart, because the bogie mass is known. A real vehicle also pitches, rolls and bends, which
# ``VerticalVehicle`` has and this model does not. And the curves here have no noise.

ratios = torch.ones(2, len(PARAMETERS), dtype=torch.float64)
ratios[1, 2:] = 1.2  # k_s, c_s and M_s, all 20 % more
lighter, heavier = model.magnitudes(ratios, frequencies_hz)
for name, change in zip(("G_p", "G_s"), (heavier - lighter).abs().amax(dim=1), strict=True):
    print(f"k_s, c_s and M_s 20 % more: largest change of |{name}| is {change:.2f}")
