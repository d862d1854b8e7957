"""
From estimates to a plan
========================

A depot has the estimates of many trips. This example makes up those of a small fleet, with the
scatter of real ones of suspnet, asks which suspension has changed and how long each will last, and
what to do about it.
"""

from datetime import date

import matplotlib.pyplot as plt
import numpy as np

from suspnet import plan_calendar
from suspnet.trains.maintenance import (
    DEFAULT_LIMITS,
    ChangeSettings,
    Part,
    PlanSettings,
    Severity,
    State,
    Train,
    cusum,
    make_plan,
    make_series,
    residuals,
    threshold,
    watch,
    with_lives,
)

plt.style.use("tableau-colorblind10")

# %%
# A history
# ---------
# One suspension, a trip every 2,000 km. Successive trips are alike (correlation 0.3). The primary
# spring loses 1 % after 160,000 km, as in the paper; the secondary damper fades from 100,000 km on.
names, scatter = ("k_p", "c_p", "k_s", "c_s"), np.array([0.0005, 0.003, 0.0006, 0.001])
km = 2000.0 * np.arange(120)
noise = np.random.default_rng(0).standard_normal((len(km), 4))
for i in range(1, len(km)):
    noise[i] = 0.3 * noise[i - 1] + np.sqrt(1 - 0.3**2) * noise[i]
estimates = np.exp(noise * scatter)
estimates[km >= 160_000, 0] *= 0.99
estimates[:, 3] *= 1 - 0.13 * np.clip((km - 100_000) / 138_000, 0, None)

values = dict(zip(names, estimates.T, strict=True))
half_widths = {name: np.full(len(km), 2 * s) for name, s in zip(names, scatter, strict=True)}

# %%
# What has changed
# ----------------
# A CUSUM adds up what each trip differs from the reference: the first 20 trips, and later ones that
# are older than ten. Its threshold comes from a stated budget, one false alarm in 1,000,000 km over
# all four parameters.
settings = ChangeSettings()
series = make_series(km, values, half_widths)
watched = watch(series, DEFAULT_LIMITS, settings)
for alarm in watched.alarms:
    print(f"{alarm.severity!s:7} {alarm.parameter} since {alarm.begin_km:,.0f} km: {alarm.words}")

limit = threshold(2000 / settings.km_per_false_alarm / 4)
rest = residuals(np.log(estimates), np.empty((*estimates.shape, 0)))
sums = cusum(rest.standard).max(axis=0)

figure, axes = plt.subplots(2, 1, sharex=True, figsize=(5.0, 4.5), layout="constrained")
for i, name in enumerate(names):
    axes[0].plot(km / 1000, 100 * estimates[:, i], ".", label=f"${name}$")
    axes[1].semilogy(km[-len(sums) :] / 1000, 1 + sums[:, i])
axes[1].axhline(1 + limit, color="0.3", ls="--", label="threshold")
axes[0].set_ylabel("% of healthy")
axes[1].set_ylabel("1 + CUSUM")
axes[1].set_xlabel("mileage [1000 km]")
axes[0].legend(ncols=4)
_ = axes[1].legend()

# %%
# How long each will last
# -----------------------
# The mileage until an act limit is passed, as a distribution, with an interval that is meant to
# hold the crossing in 80 of 100 cases. It is narrow for the damper, which fades steadily. A single
# step, as that of the spring, says little about what is to come: that interval has no end.
lives = with_lives(State(series, DEFAULT_LIMITS, watched)).lives
for name, life in lives.items():
    print(f"{name}: {life}")

# %%
# What to do
# ----------
# Three trains with two such dampers each, at different points of their lives. A damper is due
# before the probability that it has passed its limit exceeds 2 %; what is due within 90 days is
# done at one visit.
trains = [Train(f"train {i + 1}", 400_000.0, date(2026, 1, 5), 600.0) for i in range(3)]
parts = [
    Part(
        f"train {i + 1}",
        f"bogie {j + 1}",
        "c_s",
        lives["c_s"].samples_km + 60_000 * i + 12_000 * j,
        400_000.0,
        Severity.NOTICE,
    )
    for i in range(3)
    for j in range(2)
]
plan = make_plan(parts, trains, PlanSettings(), date(2026, 1, 5))
print(plan.summary)
for row in plan.rows():
    print(f"{row['what']} {row['part']} of {row['train']}, {row['suspension']}, by {row['day']}")
plan_calendar(plan, plt.figure(figsize=(5.0, 3.2), layout="constrained"))
plt.show()
