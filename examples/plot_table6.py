"""
Table VI of the paper beside what is measured
=============================================

The methods of the paper's Table VI, small enough to run while you wait: 300 training curves in
place of 2,000. In full, in about two minutes::

    suspnet-train experiment=table6

It reads the paper as its Table IV says: springs and dampers never vary together, and the features
are those of the largest peak of each curve. ``experiment=readings`` compares other readings.
"""

import csv
import shutil
import subprocess
import sysconfig
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

plt.style.use("tableau-colorblind10")
PROGRAM = shutil.which("suspnet-train", path=sysconfig.get_path("scripts"))
SMALL = ["data.n_train=300", "data.n_test=300", "data.cache_dir=null", "figures=false"]


def table6(*overrides):
    """Return the rows of table6.csv of a small run with MAPE."""
    with TemporaryDirectory() as folder:
        command = [PROGRAM, "experiment=table6", *SMALL, *overrides, "threads=1", "progress=false"]
        subprocess.run(
            [*command, "hydra.sweep.dir=run"], cwd=folder, check=True, capture_output=True
        )
        with open(Path(folder, "run", "table6.csv"), newline="") as file:
            return [row for row in csv.DictReader(file) if row["metric"] == "mape_percent"]


# %%
# Every method, read as the paper
# -------------------------------
# Mean absolute error in % (MAPE), the paper's and ours. The bound is that of Cramer and Rao, which
# no unbiased estimator beats. Kernel ridge is MSVR without its tube, and gives the same here: with
# the paper's epsilon every curve lies outside of it.

as_printed = table6("model=msvr,ridge,svr,mvgpr,linear")
OUTPUTS, MODELS = ("k_p", "c_p", "k_s", "c_s"), ("msvr", "ridge", "svr", "mvgpr", "linear")
cells = {(row["output"], row["model"]): row for row in as_printed}
print("paper, ours" + "".join(f"{model:>13}" for model in MODELS) + f"{'bound':>8}")
for output in OUTPUTS:
    rows = [cells[output, model] for model in MODELS]
    pairs = (f"{row['published'] or '-':>5}, {float(row['measured']):.2f}" for row in rows)
    bound = float(rows[0]["bound"])
    print(f"{output:11}" + "".join(f"{pair:>13}" for pair in pairs) + f"{bound:8.3f}")

# %%
# MSVR with the smaller peak too
# ------------------------------
# The same noise, but one suspension varies and all three peaks of both curves are seen.

all_peaks = table6("protocol=multi_location", "model=msvr")

figure, axis = plt.subplots(figsize=(5, 4.5), layout="constrained")
places = np.arange(len(OUTPUTS))
for shift, rows, marker, label in (
    (-0.12, as_printed, "s", "largest peaks"),
    (0.12, all_peaks, "o", "all peaks"),
):
    chosen = {row["output"]: row for row in rows if row["model"] == "msvr"}
    measured, bounds = (
        [float(chosen[output][key]) for output in OUTPUTS] for key in ("measured", "bound")
    )
    (points,) = axis.plot(places + shift, measured, marker, ms=8, label=label)
    colour = points.get_color()
    axis.hlines(bounds, places + shift - 0.1, places + shift + 0.1, colors=colour, lw=3)
axis.plot([], [], color="0.5", lw=3, label="its bound")
published = [float(cells[output, "msvr"]["published"]) for output in OUTPUTS]
axis.plot(places, published, "kx", ms=9, mew=2, label="the paper")
axis.set(yscale="log", ylim=(0.03, 40), xlabel="parameter", ylabel="MAPE [%]")
axis.set_title("MSVR, 300 training curves, 34 dB")
axis.set_xticks(places, labels=[f"${output}$" for output in OUTPUTS])
axis.set_yticks([0.1, 1, 10], labels=["0.1", "1", "10"])
axis.grid(alpha=0.3, axis="y")
figure.legend(loc="outside lower center", ncols=2)
plt.show()

# %%
# What one sees, and what not
# ---------------------------
# From the largest peaks the errors have the size of the paper's, and linear regression is last, as
# there. The order of MSVR, SVR and MV-GPR is a matter of tuning and of chance. With the smaller
# peak of the primary curve MSVR is near the bound, and far below the paper's figures. All of this
# holds for curves of the model itself: see :doc:`accuracy </accuracy>`.
