"""The monitor as a program: a replay into a folder, and what is told of it."""

import json

import pytest
from cli_runner import typed
from notified import KEY, receiving, rules_file
from trip_fixtures import changed, model_at, small_fleet

from suspnet.cli import monitor, replay
from suspnet.estimation.checkpoint import save_model
from suspnet.trains.history import History

LIVE = ("source=folder", "source.folder=incoming", "source.once=true", "live.section_s=300")
N_TRIPS = 2


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    save_model(folder, model_at())
    return folder


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Return a folder of two trips."""
    folder = tmp_path_factory.mktemp("fleet")
    for manifest in small_fleet()[:N_TRIPS]:
        changed(manifest, folder, manifest.stem)
    return folder


def monitored(folder, run, fleet, *more):
    return typed(
        monitor, f"run={run}", f"suspensions={fleet}", "store=fleet.db", *LIVE, *more, cwd=folder
    )


def test_replay_and_monitor_fill_the_history(tmp_path, run, fleet, monkeypatch):
    monkeypatch.setenv("SUSPNET_WEBHOOK_SECRET", KEY)
    sent = typed(replay, f"trips={fleet}", "out=incoming", "frame_s=10", cwd=tmp_path)
    assert sent.returncode == 0, sent.stderr
    with receiving() as (url, messages):
        rules = rules_file(
            tmp_path / "notify.json",
            {"hook": {"kind": "webhook", "url": url}},
            {"all": {"channels": ["hook"], "digest": "00:00"}},
        )
        ended = monitored(tmp_path, run, fleet, f"notify={rules}")
    assert ended.returncode == 0, ended.stderr
    assert json.loads(messages[0][1])["kind"] == "digest"
    assert "frames: " in ended.stderr
    assert "taken" in ended.stderr
    with History(tmp_path / "fleet.db") as store:
        (key,) = store.places()
        trips = store.read(*key)
    assert [trip.mileage_km for trip in trips] == [1000.0, 2000.0]
    assert all(0.3 < trip.estimates["k_p"] < 3 for trip in trips)
    again = monitored(tmp_path, run, fleet)
    assert again.returncode == 0
    with History(tmp_path / "fleet.db") as store:
        assert store.read(*key) == trips


@pytest.mark.representatives(3)
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["run=none"], "run=none does not exist"),
        (["suspensions=none"], "none"),
        (["journal=none/journal"], "there is no folder"),
        (["live.section_s=1"], "live.section_s"),
        (["live.every_s=600"], "every_s"),
        (["store=none/fleet.db"], "there is no folder"),
        (["source=other"], "other"),
    ],
)
def test_mistakes_are_one_line(tmp_path, run, fleet, changes, words):
    (tmp_path / "incoming").mkdir()
    ended = monitored(tmp_path, run, fleet, *changes)
    assert ended.returncode == 1
    assert words in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("missing", ["run", "suspensions", "store"])
def test_what_is_missing_is_named(tmp_path, missing):
    given = {"run": "run=a", "suspensions": "suspensions=b", "store": "store=c"}
    del given[missing]
    ended = typed(monitor, *given.values(), cwd=tmp_path)
    assert ended.returncode == 1
    assert f"`{missing}` is missing" in ended.stderr
