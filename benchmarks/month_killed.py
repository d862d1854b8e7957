"""A month of 50 suspensions, live, with monitors and pages that are killed: the batch's history?

    python benchmarks/month_killed.py FOLDER                     # on PostgreSQL
    python benchmarks/month_killed.py FOLDER --store fleet.db    # on SQLite
    python benchmarks/month_killed.py FOLDER --quick    # sums of samples for estimates

Simulates a trip of five minutes a day of each suspension (three sensors at 400, 250 and 250 Hz,
five suspensions of which lose a damper), evaluates the folder in one go, and replays it, as fast as
it is taken, through Mosquitto to two monitors with one store, which `suspnet serve` shows. All
three are killed with SIGKILL at random moments and started again, by a loop in place of systemd's
``Restart=always``. Prints how many kills there were and what differs from the batch in the store
and in the answers of the pages' API; the exit code is 1 if anything does. FOLDER keeps trips, model
and batch for the next run.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import random
import re
import shutil
import signal
import socket
import sys
import time
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from datetime import datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import postgres_server
from fault_injection import ended, start
from live_frames import Mosquitto, Sender

from suspnet.depot.live.broker import Broker
from suspnet.depot.live.replay import Replay
from suspnet.estimation.trained import TrainedModel
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.records import OK, Key, Quality, TripResult
from suspnet.trains.history import History
from suspnet.trains.recordings.recording import Recording
from suspnet.trains.simulation.fleet import Fleet
from suspnet.trains.simulation.writing import time_between
from suspnet.trains.trips import trip

RATES = [
    f"fleet.sensors.{n}.rate_hz={r}" for n, r in (("axle_box", 400), ("bogie", 250), ("body", 250))
]
N_PARTS = 2
MOST_AWAY_S = 5.0
"""Longest time until a killed program is started again, [s]."""
QUIET_S = 60.0
"""Time after which an open section is reported as if it had ended, [s]: with the last trips."""
SAME = ("status", "flags", "reason", "mileage_km", "start", "worn", "vehicle", "healthy_si")
"""Fields of a trip that are equal; numbers of the estimate are so to a tolerance."""
RTOL = 1e-9
"""Signals cut into frames pass the same filters in other steps, which changes the last digits."""


def sums_of_samples(
    recording: Recording, models: Sequence[TrainedModel], _: TripSettings
) -> dict[str, Any]:
    """Return an outcome in which sums over all samples stand in for the estimate, which takes long.

    A sample that is lost, doubled or in another place changes them. c_s fades over the month.
    """
    signals = recording.signals[:, recording.usable]
    at = np.linspace(-1, 1, signals.shape[1])
    sums = [*np.sqrt((signals**2).mean(axis=1)), *np.abs(signals * at).mean(axis=1)]
    values = {
        name: float(1 + 0.02 * np.sin(100 * one))
        for name, one in zip(models[0].task.outputs, sums, strict=False)
    }
    values["c_s"] *= float(np.interp(recording.manifest.mileage_km, [15e3, 30e3], [1, 0.6]))
    quality = Quality(
        duration_s=recording.duration_s,
        usable_percent=100 * float(recording.usable.mean()),
        speed_m_per_s=float(np.nanmean(recording.speed_m_per_s)),
        n_averages=20.0,
    )
    healthy = dict(zip(values, models[0].healthy.values.tolist(), strict=True))
    return {
        "status": OK,
        "estimates": values,
        "half_widths": dict.fromkeys(values, 0.01),
        "healthy_si": healthy,
        "healthy_half_widths": dict.fromkeys(values, 0.0),
        "quality": quality,
    }


class Programs:
    """Programs that are started again when they end; `kills` and `starts` count by name."""

    def __init__(self, folder: Path, rng: random.Random) -> None:
        self.kills: Counter[str] = Counter()
        self.starts: Counter[str] = Counter()
        self._folder, self._rng = folder, rng
        self._commands: dict[str, tuple[str, list[str]]] = {}
        self._pids: dict[str, int] = {}

    def add(self, name: str, program: str, arguments: list[str]) -> None:
        """Start a program."""
        self._commands[name] = program, arguments
        self.look()

    def look(self) -> None:
        """Start what is not running."""
        for name, (program, arguments) in self._commands.items():
            pid = self._pids.get(name)
            if pid is None or ended(pid, 0.02) is not None:
                (where := self._folder / name).mkdir(exist_ok=True)
                self._pids[name] = start(program, arguments, where)
                self.starts[name] += 1

    def kill(self, name: str = "") -> None:
        """Kill one of them without warning, a random one if none is named."""
        name = name or self._rng.choice(list(self._pids))
        os.kill(self._pids[name], signal.SIGKILL)
        self.kills[name] += 1

    def end(self) -> None:
        """End all as systemd does."""
        for pid in self._pids.values():
            os.kill(pid, signal.SIGTERM)
        assert all(ended(pid, 60) is not None for pid in self._pids.values())


def run(program: str, arguments: list[str], folder: Path) -> None:
    """Run a program to its end."""
    pid = start(program, arguments, folder)
    code = ended(pid, 7200)
    assert code in (0, 2, 3, 4), (program, code, (folder / "output.log").read_text()[-2000:])


def prepare(folder: Path, n_cars: int, n_days: int) -> None:
    """Write trips, one a day, and a model of each bogie."""
    common = ["progress=false"]
    wear = f"scenario.changes.c_s={{from_km:{n_days * 500},to_km:{n_days * 1000},ratio:0.6}}"
    fleet = [f"fleet.n_trips={n_days}", f"fleet.last_mileage_km={n_days * 1000}", "fleet.minutes=5"]
    vehicle = ["generator=best", "scatter=0"]
    if not (folder / "model").exists():
        data = ["data.n_train=2000", "data.n_test=300", "data.n_calibrate=400", "figures=false"]
        data += ["data.minutes=5", "data.rates_hz=[400,250,250]", "threads=1"]
        data += ["model.feature_map=nystroem", "model.n_components=512"]
        for bogie in ("leading", "trailing"):
            where = [f"generator.bogie={bogie}", f"hydra.run.dir=model/{bogie}"]
            run("train", ["experiment=trips", *data, *common, *where], folder)
    if not (folder / "trips").exists():
        of_fleet = [f"trains={n_cars // 5}", "cars=5", "n_wearing=5", "scenario=damper_fade", wear]
        arguments = [*of_fleet, *fleet, *RATES, *vehicle, *common, "out=writing", "workers=2"]
        run("simulate", arguments, folder)
        for file in (folder / "writing").rglob("trip_*.yaml"):
            file.write_text(_daily(file))
        (folder / "writing").rename(folder / "trips")
    for several in (folder / "trips").glob("*/"):
        (where := folder / "suspensions" / several.name).mkdir(parents=True, exist_ok=True)
        first = min(several.glob("*.yaml"))  # all of them take seconds to read at each start
        shutil.copy(first, where)


def evaluate(folder: Path) -> None:
    """Write the history of the evaluation of the whole folder, unless it is there."""
    if not (folder / "batch.db").exists():
        options = ["run=model", "trips=trips", "store=writing.db", "figures=false"]
        options += ["monitor.workers=1", "progress=false", "hydra.run.dir=batch"]
        run("evaluate", options, folder)
        (folder / "writing.db").rename(folder / "batch.db")


def _daily(file: Path) -> str:
    """Return a manifest with a start a day after that of the trip before, as in a month of days."""
    text = file.read_text()
    (written,) = re.findall(r"^start: (.*)$", text, re.M)
    start = datetime.fromisoformat(written.strip("'"))
    index = int(file.stem.removeprefix("trip_")) - 1
    a_trip = time_between(Fleet(n_trips=1, last_mileage_km=1000.0, minutes=5.0))
    return text.replace(written, (start + (timedelta(days=1) - a_trip) * index).isoformat())


def send(port: int, trips: Path) -> None:
    """Send the frames of all trips to a broker, as fast as it takes them."""
    sender = Sender(Broker(port=port), in_flight=100)
    for frame in Replay(trips, frame_s=10.0).frames():
        sender.send(frame)
    sender.close()


def live(
    folder: Path, where: Path, store: str, n_trips: int, n_kills: int, mean_up_s: float, seed: int
) -> Programs:
    """Replay all trips to programs that are killed; return these once the store has all trips."""
    rng = random.Random(seed)
    programs, port = Programs(where, rng), _free_port()
    broker = Mosquitto(where).start()
    common = [f"run={folder}/model", f"suspensions={folder}/suspensions", "source=mqtt"]
    common += [f"store='{store}'", f"source.broker.port={broker.port}", f"live.idle_s={QUIET_S:g}"]
    try:
        for k in range(1, N_PARTS + 1):
            part = [f"source.part={k}/{N_PARTS}", "journal=journal"]
            programs.add(f"monitor_{k}", "monitor", [*common, *part])
        until(lambda: (where / "mosquitto.log").exists() and _n_connected(where) >= N_PARTS)
        programs.add("serve", "serve", [f"store='{store}'", f"port={port}", "refresh_s=1"])
        time.sleep(2)
        context = multiprocessing.get_context("fork")
        sending = context.Process(target=send, args=(broker.port, folder / "trips"))
        sending.start()
        assert sending.pid is not None
        code, stored, last_s = None, 0, time.monotonic()
        n_last = len(list((folder / "suspensions").iterdir()))
        while code is None or programs.kills.total() < n_kills or stored < n_trips:
            # the last trips are reported after a silence that no kill interrupts
            if stored < n_trips - n_last or programs.kills.total() < n_kills:
                programs.kill()
            time.sleep(rng.uniform(0, MOST_AWAY_S))
            programs.look()
            time.sleep(rng.expovariate(1 / mean_up_s))
            code = ended(sending.pid, 0.02) if code is None else code
            before, stored = stored, _n_stored(store)
            print(f"{programs.kills.total()} kills, {stored} trips stored", flush=True)
            last_s = time.monotonic() if stored != before else last_s
            assert time.monotonic() - last_s < 600, "no trip was stored for ten minutes"
        assert code == 0
        before = None
        while before != (now := _revisions(store)):  # ends: once all is reported
            before = now
            time.sleep(2 * QUIET_S)
            programs.look()
        # rates of wear are learned again only when many trips are new: here, from all of them
        programs.kill("serve")
        time.sleep(MOST_AWAY_S)
        programs.look()
        pages = _pages(port)
    finally:
        programs.end()
        broker.end()
    (where / "pages.json").write_text(json.dumps(pages))
    return programs


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _n_connected(where: Path) -> int:
    return (where / "mosquitto.log").read_text().count("New client connected")


def _revisions(store: str) -> dict[Key, int]:
    with History(store, must_exist=True) as history:
        return history.revisions()


def _n_stored(store: str) -> int:
    with suppress(ValueError), History(store, must_exist=True) as history:
        return sum(len(one.trip) for one in history.series())
    return 0


def until(condition: object, seconds: float = 120.0) -> None:
    """Wait until a condition holds."""
    last_s = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < last_s, "too slow"
        time.sleep(0.1)


def _pages(port: int) -> dict[str, list[object]]:
    """Return what the API says about suspensions, alarms and plan, without times of reading."""

    found: dict[str, list[object]] = {}

    def is_read() -> bool:
        with suppress(OSError):
            for name in ("suspensions", "alarms", "plan"):
                with urlopen(f"http://127.0.0.1:{port}/api/v1/{name}") as answer:
                    content = json.load(answer)
                if not content["complete"] or content["fault"]:
                    return False
                found[name] = content["items"]
            return True
        return False

    until(is_read)
    return found


def compare(batch: History, found: History) -> Counter[str]:
    """Return how many trips and alarms there are, and how many are not the same."""
    counts: Counter[str] = Counter()
    keys = batch.places()
    counts["suspensions"] = len(keys)
    counts["other suspensions"] = len(set(keys) ^ set(found.places()))
    for key in keys:
        expected, got = batch.read(*key), found.read(*key)
        counts["trips"] += len(expected)
        counts["missing or doubled"] += abs(len(got) - len(expected))
        pairs = list(zip(expected, got, strict=False))
        counts["other trips"] += sum(not _is_same(*pair) for pair in pairs)
        counts["alarms"] += len(batch.alarms(*key))
        counts["other alarms"] += _alarms(batch, key) != _alarms(found, key)
    return counts


def _is_same(one: TripResult, other: TripResult) -> bool:
    numbers = [
        np.allclose([a[k] for k in a], [b.get(k, np.nan) for k in a], rtol=RTOL, atol=0)
        for a, b in ((one.estimates, other.estimates), (one.half_widths, other.half_widths))
        if a.keys() == b.keys() or not print("other outputs", one.trip)
    ]
    same = [getattr(one, name) == getattr(other, name) for name in SAME]
    if not all([*same, *numbers]) or len(numbers) < 2:
        print("differs:", one.place, one.trip, dict(zip(SAME, same, strict=True)), numbers)
        return False
    return True


def _alarms(store: History, key: Key) -> list[dict[str, object]]:
    return [{k: str(v) for k, v in asdict(one).items()} for one in store.alarms(*key)]


def main() -> None:
    """Prepare, kill and compare."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--store", help="an SQLite file; PostgreSQL of its own if not given")
    parser.add_argument("--quick", action="store_true", help="sums of samples for estimates")
    parser.add_argument("--cars", type=int, default=25, help="cars of two suspensions, 5 a train")
    parser.add_argument("--days", type=int, default=30)
    parser.add_argument("--kills", type=int, default=60, help="at least so many, until the end")
    parser.add_argument("--up", type=float, default=10.0, help="mean time between kills [s]")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    if given.quick:
        trip.outcome_of = sums_of_samples  # in all programs: they are forks of this process
    folder = given.folder.absolute()
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("train", "simulate", "evaluate", "monitor", "replay", "serve"):
        import_module(f"suspnet.cli.{name}")
    prepare(folder, given.cars, given.days)
    where = folder / f"live_{time.strftime('%H%M%S')}"
    where.mkdir()
    store = postgres_server.url() if given.store is None else str(where / given.store)
    assert store is not None, "PostgreSQL is not installed: give --store FILE"
    n_trips = 2 * given.cars * given.days
    begin_s = time.monotonic()
    programs = live(folder, where, store, n_trips, given.kills, given.up, given.seed)
    print(
        f"{time.monotonic() - begin_s:.0f} s; kills {dict(programs.kills)}, "
        f"starts {dict(programs.starts)}"
    )
    evaluate(folder)
    with History(folder / "batch.db") as batch, History(store) as found:
        counts = compare(batch, found)
    port = _free_port()
    pid = start("serve", [f"store={folder}/batch.db", f"port={port}"], folder)
    expected = _pages(port)
    os.kill(pid, signal.SIGTERM)
    ended(pid, 30)
    pages = json.loads((where / "pages.json").read_text())
    for name, items in expected.items():
        counts[f"other items of {name}"] = sum(
            a != b for a, b in zip(items, pages[name], strict=False)
        )
        counts[f"other items of {name}"] += abs(len(items) - len(pages[name]))
        counts[f"items of {name}"] = len(items)
    print(json.dumps(counts, indent=2))
    (folder / "expected.json").write_text(json.dumps(expected))
    sys.exit(any(n for name, n in counts.items() if name.startswith(("other", "missing"))))


if __name__ == "__main__":
    main()
