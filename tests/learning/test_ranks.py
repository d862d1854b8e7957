"""One fit spread over processes is the fit of one process."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.multiprocessing
from cli_runner import SMALL, command, run_main, typed
from forked import forks
from rank_worker import CASES, N_RANKS, arrays, samples, work
from safetensors.numpy import load_file

from suspnet.cli import train
from suspnet.learning import ranks

N_TORCHRUN = 2
"""Processes of a whole program."""


def torchrun(n_ranks, *overrides, cwd):
    launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={n_ranks}"]
    return command("train.py", *overrides, *SMALL, "threads=1", launcher=launcher, cwd=cwd)


@pytest.fixture(scope="module")
def spread(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranks")
    forks()  # one server imports what all ranks need
    torch.multiprocessing.start_processes(
        work, (folder,), nprocs=N_RANKS, start_method="forkserver"
    )
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
    assert all("needs all samples in one process" in str(found["refused"]) for found in spread)


def test_one_process_is_all_there_is():
    values = torch.tensor([1.0, 2.0])
    assert not ranks.is_distributed()
    assert ranks.is_rank_zero()
    assert torch.equal(ranks.all_reduce(values), values)
    assert torch.equal(ranks.broadcast(values), values)
    assert torch.equal(ranks.all_gather(values[:, None]), values[:, None])
    assert ranks.shard(5) == slice(0, 5)


@pytest.mark.slow
def test_torchrun_trains_the_model_of_one_process(tmp_path):
    ended = torchrun(N_TORCHRUN, "hydra.run.dir=two", cwd=tmp_path)
    assert ended.returncode == 0, ended.stderr
    is_the_model_of_one_process(tmp_path, ended.stdout)


def is_the_model_of_one_process(tmp_path, printed):
    """Compare the run that several processes trained with that of this process."""
    one, two = tmp_path / "one", tmp_path / "two"
    run_main(train, one, *SMALL, "threads=1")
    assert printed.count("| k_p ") == 1  # one process prints the table
    assert sorted(p.name for p in tmp_path.iterdir()) == ["one", "two"]
    expected, found = (load_file(folder / "model.safetensors") for folder in (one, two))
    assert set(found) == set(expected)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, rtol=0, atol=1e-8, err_msg=name)
    scores = [json.loads(Path(f, "metrics.json").read_text())["scores"] for f in (one, two)]
    for output, values in scores[0].items():
        assert scores[1][output] == pytest.approx(values, rel=1e-9)


def test_multirun_is_not_spread_and_said_so_once(tmp_path):
    """As torchrun starts two ranks; the mistake is found before they join."""
    errors = []
    for rank in ("0", "1"):
        variables = {"RANK": rank, "WORLD_SIZE": "2"}
        given = ["-m", "group=primary,secondary", *SMALL, "threads=1"]
        ended = typed(train, *given, cwd=tmp_path, **variables)
        assert ended.returncode != 0
        errors += [line for line in ended.stderr.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "a multirun cannot be spread by torchrun" in errors[0]


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
