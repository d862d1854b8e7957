"""One fit spread over processes is the fit of one process."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.multiprocessing
from cli_runner import SMALL, command, run_main
from learning_reference import smooth_data
from safetensors.numpy import load_file

from suspnet.cli import train
from suspnet.learning import MSVR, Scaling, ranks

CASES = {
    "rff": {"feature_map": "rff", "n_components": 60},
    "no intercept": {"feature_map": "orf", "n_components": 60, "fit_intercept": False},
    "wide tube": {"feature_map": "rff", "n_components": 60, "epsilon": 0.2},
    "nystroem": {"feature_map": "nystroem", "n_components": 40, "sigma": 0.7},
    "exact": {"feature_map": "exact", "sigma": 0.7},
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
    # The basis of the exact kernel's faintest directions is rounding, whoever computes it.
    return found if case["feature_map"] == "exact" else found | model.state()


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
    found["shards"] = np.array([[ranks.shard(n).start, ranks.shard(n).stop] for n in (0, 2, 7)])
    found["is_rank_zero"] = np.array(ranks.is_rank_zero())
    np.savez(folder / f"{rank}.npz", **found)
    ranks.stop()


def torchrun(n_ranks, *overrides, cwd):
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={n_ranks}"]
    return command("train.py", *overrides, *SMALL, "threads=1", launcher=launcher, cwd=cwd)


@pytest.fixture(scope="module")
def spread(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranks")
    torch.multiprocessing.spawn(work, (folder,), nprocs=N_RANKS)
    return [dict(np.load(folder / f"{rank}.npz")) for rank in range(N_RANKS)]


@pytest.mark.parametrize("name", CASES)
def test_every_rank_finds_the_model_of_one_process(spread, name):
    alone = arrays(*samples(), **CASES[name])
    assert np.ptp(alone["y"], axis=0).min() > 0.5
    for found in spread:
        for key, value in alone.items():
            # Sums in another order; the matrices of Eq. (9) are never smaller than I.
            np.testing.assert_allclose(found[f"{name}.{key}"], value, rtol=1e-10, atol=1e-8)


def test_shards_cover_everything_once_and_rank_zero_writes(spread):
    for row, n in enumerate((0, 2, 7)):
        shards = [range(*found["shards"][row]) for found in spread]
        assert [i for shard in shards for i in shard] == list(range(n))
    assert [bool(found["is_rank_zero"]) for found in spread] == [True, False, False]


def test_one_process_is_all_there_is():
    values = torch.tensor([1.0, 2.0])
    assert not ranks.is_distributed()
    assert ranks.is_rank_zero()
    assert torch.equal(ranks.all_reduce(values), values)
    assert torch.equal(ranks.broadcast(values), values)
    assert torch.equal(ranks.all_gather(values[:, None]), values[:, None])
    assert ranks.shard(5) == slice(0, 5)


def test_torchrun_trains_the_model_of_one_process(tmp_path):
    one, three = tmp_path / "one", tmp_path / "three"
    assert command("train.py", *SMALL, "threads=1", f"hydra.run.dir={one}").returncode == 0
    started = torchrun(N_RANKS, f"hydra.run.dir={three}", cwd=tmp_path)
    assert started.returncode == 0, started.stderr
    assert started.stdout.count("| k_p ") == 1  # one process prints the table
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one", "three"]
    expected, found = (load_file(folder / "model.safetensors") for folder in (one, three))
    assert set(found) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-8, err_msg=name)
    scores = [json.loads(Path(f, "metrics.json").read_text())["scores"] for f in (one, three)]
    for output, values in scores[0].items():
        assert scores[1][output] == pytest.approx(values, rel=1e-9)


def test_multirun_is_not_spread_and_said_so_once(tmp_path):
    started = torchrun(2, "-m", "group=primary,secondary", cwd=tmp_path)
    assert started.returncode != 0
    own = [line for line in started.stderr.splitlines() if line.startswith("error:")]
    assert len(own) == 1
    assert "a multirun cannot be spread by torchrun" in own[0]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("model=linear", "model=linear cannot be spread over processes, only msvr"),
        ("search=table5", "a search cannot be spread over processes"),
    ],
)
def test_what_cannot_be_spread_is_named(override, message, tmp_path, monkeypatch):
    monkeypatch.setattr(ranks, "is_distributed", lambda: True)
    monkeypatch.setattr(ranks, "is_rank_zero", lambda: True)
    with pytest.raises(SystemExit, match=message):
        run_main(train, tmp_path / "run", override, *SMALL, "threads=1")
