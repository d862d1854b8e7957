"""What each of several processes does in test_ranks.py; it imports no more than that needs."""

import importlib.util

import numpy as np
import torch
from learning_reference import smooth_data

from suspnet.learning import MSVR, Scaling, ranks

CASES = {
    "rff": {"feature_map": "rff", "n_components": 60},
    "no intercept": {"feature_map": "orf", "n_components": 60, "fit_intercept": False},
    "wide tube": {"feature_map": "rff", "n_components": 60, "epsilon": 0.2},
    "nystroem": {"feature_map": "nystroem", "n_components": 40, "sigma": 0.7},
}
if importlib.util.find_spec("finufft"):
    CASES["equispaced"] = {"feature_map": "equispaced"}
N_RANKS, ROWS = 3, (70, 30, 0)
"""Shards of unlike size; the last rank has no rows."""


def samples():
    return smooth_data(3, n_samples=sum(ROWS))


def arrays(X, Y, **case):
    """Everything that a fit and its scaling find."""
    scaling = Scaling.of(X, log=False, all_reduce=ranks.all_reduce)
    model = MSVR(**({"sigma": 1.0, "C": 10.0} | case), distributed=True)
    model.fit(scaling.apply(X), Y)
    counts = np.array([model.n_iter_, model.support_fraction_, model.objective_])
    predicted = model.predict(scaling.apply(smooth_data(4, n_samples=50)[0]))
    found = {"mean": scaling.mean, "scale": scaling.scale, "numbers": counts, "y": predicted}
    return found | model.state()


def work(rank, folder):
    """Fit every case with this rank's rows, then keep what was found."""
    torch.set_num_threads(1)
    store = torch.distributed.FileStore(str(folder / "store"), N_RANKS)
    torch.distributed.init_process_group("gloo", store=store, rank=rank, world_size=N_RANKS)
    X, Y = samples()
    rows = slice(sum(ROWS[:rank]), sum(ROWS[: rank + 1]))
    found = {
        f"{name}.{key}": value
        for name, case in CASES.items()
        for key, value in arrays(X[rows], Y[rows], **case).items()
    }
    try:
        MSVR(feature_map="exact", distributed=True).fit(X, Y)
    except ValueError as error:
        found["refused"] = np.array(str(error))
    found["shards"] = np.array([[ranks.shard(n).start, ranks.shard(n).stop] for n in (0, 2, 7)])
    found["is_rank_zero"] = np.array(ranks.is_rank_zero())
    np.savez(folder / f"{rank}.npz", **found)
    ranks.stop()
