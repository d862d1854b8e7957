"""
What sensors can tell, before you buy them
==========================================

No unbiased estimator is more accurate than the Cramer-Rao bound. It follows from the vehicle, the
sensors and the length of a trip alone, without any data, so it can be asked before a sensor is
bought: how much noise may it have, is one at each place enough, and must there be one on each
side?
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from suspnet import (
    PARAMETERS,
    EstimateSettings,
    VerticalVehicle,
    cramer_rao,
    fisher_information,
    read_vehicles,
    recording_information,
    sensor_places,
)

plt.style.use("tableau-colorblind10")
MINUTES = 20.0
HEALTHY = np.ones((1, len(PARAMETERS)))

# %%
# The vehicle
# -----------
# Its lengths, radii of gyration and what governs its roll are uncertain, as those of a vehicle are
# of which only a drawing is known: the priors say by how much. Springs and dampers are what is
# asked for, relative to the drawing. The body rolls: a sensor on one side feels the cross level of
# the track, the mean of a pair, left and right, does not.

vehicle = read_vehicles()["am96"]
prior = VerticalVehicle(vehicle, parts=("roll",), distribution="prior").distribution
uncertain = {
    name: float(deviation)
    for name, deviation in zip(prior.names, prior.deviations, strict=True)
    if not name.startswith("healthy")
}
for name, deviation in uncertain.items():
    print(f"{name:24} {deviation:4.0%}")
pairs = VerticalVehicle(vehicle, parts=("roll",), distribution=uncertain)
left_only = replace(pairs, sensor_lateral_m=(1.0, 1.0, 1.0))
print("\nplaces of sensors:", *sensor_places(pairs), sep="\n  ")

# %%
# The bound
# ---------
# ``counts`` says how many sensors there are at each place; two of them have half the noise of one.
# Springs, dampers, car-body mass and the uncertain numbers are all unknown, and so is how rough
# the track is.


def observed(generator, snr_db=34.0):
    """Return trips of a vehicle as they are recorded and estimated."""
    return EstimateSettings(snr_db=snr_db, minutes=MINUTES).bound(vehicle).observer(generator)


def bounds_percent(observer, counts):
    """Return the least standard deviation of each parameter, (n_parameters,), [%]."""
    (information,) = recording_information(observer, HEALTHY, PARAMETERS, [counts])
    return 100 * cramer_rao(information)[0]


# %%
# Noise, and one side or both
# ---------------------------

CHOICES = {
    "a pair at each place": (pairs, [2, 2, 2]),
    "one sensor at each place, left": (left_only, [1, 1, 1]),
}
snr_db = np.arange(14.0, 60.0, 10.0)
names, styles = PARAMETERS[:4], ("o-", "s--", "^-.", "v:")
figure, axes = plt.subplots(2, 1, figsize=(5, 7), sharex=True, sharey=True, layout="constrained")
for axis, (title, (generator, counts)) in zip(axes, CHOICES.items(), strict=True):
    found = np.array([bounds_percent(observed(generator, value), counts) for value in snr_db])
    for j, (name, style) in enumerate(zip(names, styles, strict=True)):
        axis.semilogy(snr_db, found[:, j], style, label=f"${name}$")
    axis.axvline(34.0, color="0.5", lw=0.8)
    axis.set(ylabel="least standard deviation [%]", title=f"20 minutes, {title}")
    axis.set_yticks([0.001, 0.01, 0.1, 1], labels=["0.001", "0.01", "0.1", "1"])
    axis.minorticks_off()
    axis.grid(alpha=0.3)
    axis.legend(ncols=2)
axes[1].set_xlabel("signal to noise of each sensor [dB]")
plt.show()

# %%
# Number and places
# -----------------
# The noise of the paper's sensors, 34 dB (the grey line), and other choices.

rows = CHOICES | {
    "one, left and right of roll alike": (pairs, [1, 1, 1]),
    "pairs, without the axle box": (pairs, [0, 2, 2]),
    "pairs, without the frame": (pairs, [2, 0, 2]),
    "pairs, without the body": (pairs, [2, 2, 0]),
}
print(f"{'34 dB, 20 minutes; bound in %':34}" + "".join(f"{name:>8}" for name in PARAMETERS))
for title, (generator, counts) in rows.items():
    found = bounds_percent(observed(generator), counts)
    print(f"{title:34}" + "".join(f"{value:8.2g}" for value in found))

# %%
# The bounds are those of the whole recordings. An estimate makes less of them: neighbouring bins
# of its spectra leak into each other. What the responses of one sensor at each place still hold,
# pairs being taken as one sensor that feels no roll:

for title, generator in (("estimate, pairs", pairs), ("estimate, left ones", left_only)):
    information = fisher_information(observed(generator), HEALTHY, PARAMETERS)
    found = 100 * cramer_rao(information)[0]
    print(f"{title:34}" + "".join(f"{value:8.2g}" for value in found))

# %%
# What one sees, and what not
# ---------------------------
# Sensors on one side cost a factor of about five, as much as 14 dB more noise. The frame is the
# sensor to have; the axle box adds the least.
#
# The bounds are far below the errors of any real reading: they take the physics as known but for
# these few numbers. Bushings, rubber, bending and what no model holds cost much more than noise
# does, so take bounds as a comparison of sensors, not as a promise: see :doc:`trust </trust>`.
# ``suspnet.layout_bounds`` compares more places, for each spring and damper of a bogie.
