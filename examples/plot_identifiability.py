"""
What sensors can tell, before you buy them
==========================================

No unbiased estimator is more accurate than the Cramer-Rao bound. It follows from the vehicle, the
sensors and the length of a trip alone, without any data, so it can be asked before a sensor is
bought: where should sensors be, and how much noise may they have?
"""

import matplotlib.pyplot as plt
import numpy as np

from suspnet import COMPONENTS, EstimateSettings, SpatialVehicle, layout_bounds, read_vehicles

plt.style.use("tableau-colorblind10")

# %%
# The vehicle and the places
# --------------------------
# Springs and dampers of the twelve places of a bogie, and the mass of the car body, are asked for.
# All other numbers of the vehicle are known as well as its drawing and five healthy trips tell, and
# how rough the track is, is unknown in every frequency bin.

vehicle = SpatialVehicle(read_vehicles()["am96"], parts=("frame_sway", "frame_yaw"))
boxes = ("axle_box_axle1_left", "axle_box_axle1_right")
frame = ("frame_axle1_left", "frame_axle1_right")
body = ("body_left", "body_right")
pairs = (*boxes, *frame, *body)
layouts = {
    "six: a pair at each place": pairs,
    "five: axle box on one side": (*boxes[:1], *frame, *body),
    "four: no axle box": (*frame, *body),
    "four: no frame": (*boxes, *body),
}

# %%
# Where sensors should be
# -----------------------
# One standard deviation of each kind of part, the worst of its places, on a trip of 20 minutes with
# the noise of the paper's sensors, 34 dB.

KINDS = ("k_p", "c_p", "k_s", "c_s")


def largest(bounds):
    """Return the largest bound of each kind of part, [%]."""
    return [
        max(bound for name, bound in zip(COMPONENTS, bounds.learnt, strict=True) if kind in name)
        for kind in KINDS
    ]


print(f"{'bound in %':34}" + "".join(f"{kind:>8}" for kind in KINDS))
for bounds in layout_bounds(vehicle, layouts):
    print(f"{bounds.layout:34}" + "".join(f"{value:8.2g}" for value in largest(bounds)))

# %%
# Noise
# -----
# The six sensors of the first row, with more noise and with less; the grey line is 34 dB.

snr_db = np.array([14.0, 34.0, 54.0])
by_noise = np.array(
    [
        largest(layout_bounds(vehicle, {"six": pairs}, EstimateSettings(snr_db=value))[0])
        for value in snr_db
    ]
)
figure, axis = plt.subplots(figsize=(5, 3.5), layout="constrained")
for j, (kind, style) in enumerate(zip(KINDS, ("o-", "s--", "^-.", "v:"), strict=True)):
    axis.semilogy(snr_db, by_noise[:, j], style, label=f"${kind}$")
axis.axvline(34.0, color="0.5", lw=0.8)
axis.set(xlabel="signal to noise of each sensor [dB]", ylabel="least standard deviation [%]")
axis.grid(alpha=0.3)
axis.legend(ncols=2)
plt.show()

# %%
# What one sees, and what not
# ---------------------------
# The bounds are far below the errors of any real reading: they take the physics as known but for
# numbers with a prior. What no model holds costs much more than noise does, so take bounds as a
# comparison of sensors, not as a promise: see :doc:`trust </trust>`. More layouts, and what to buy,
# are on the page on :doc:`parts </parts>`.
