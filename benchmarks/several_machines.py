"""What a suspension, a broker and a store cost when several monitors share them: docs/operation.md.

    suspnet simulate scenario=healthy generator=best out=trips/bench fleet.n_trips=1
    python train.py experiment=trips hydra.run.dir=outputs/bench data.minutes=20 \
        data.n_train=2000 data.n_test=200 data.n_calibrate=500 figures=false
    python benchmarks/several_machines.py outputs/bench trips/bench monitors
    python benchmarks/several_machines.py outputs/bench trips/bench writers
    python benchmarks/several_machines.py outputs/bench trips/bench evaluate

``monitors``: 24 suspensions of three channels at 5000, 2000 and 2000 Hz send frames of 1 s for 20
minutes of signal to Mosquitto; 1, 2 and 4 monitors take them (``source.part``) into one PostgreSQL.
``writers``: programs that do nothing but store trips as monitors do, with histories of some length,
in one SQLite file and one PostgreSQL.
``evaluate``: the trips of a folder, which should be many, read by processes of this machine.

All numbers are processor time of each program, as the system counts it, so that they hold on a busy
machine; what starting a program takes is not counted, nor the sending of frames. Only trips/s are
of wall time.
"""

from __future__ import annotations

import os
import signal
import sys
import tempfile
import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from importlib import import_module
from itertools import product
from pathlib import Path

import numpy as np
import psycopg
import yaml

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
import postgres_server
from fault_injection import ended, start
from live import Template
from live_frames import Mosquitto, Sender

from suspnet.depot.live.broker import Broker
from suspnet.depot.live.replay import Replay
from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.parameters import DEFAULT_LIMITS
from suspnet.ground.records import Place, TripResult
from suspnet.trains.history import History
from suspnet.trains.maintenance.change import ChangeSettings
from suspnet.trains.trips.earlier import keep_trips
from suspnet.trains.trips.trip import evaluate_trip

TICKS = os.sysconf("SC_CLK_TCK")
FRAMES_S = 4
"""Frames of a suspension in a second: three sensors and the speed."""
N_FLEET, SECTION_S = 5000, 1200
"""The fleet that is asked for, and the length of a section, [s]."""


def cpu_s(pids: Sequence[int]) -> float:
    """Return the processor time of processes and of their children that have ended, [s]."""
    found = 0
    for pid in pids:
        with suppress(FileNotFoundError, ProcessLookupError):
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
            found += sum(map(int, fields[11:15]))
    return found / TICKS


def memory_mib(pid: int) -> float:
    """Return the largest memory of a process so far, [MiB]."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def disk_mib(pid: int) -> float:
    """Return what a process has written to disks, [MiB]."""
    return int(Path(f"/proc/{pid}/io").read_text().split("\nwrite_bytes: ")[1].split()[0]) / 2**20


def family(pid: int) -> list[int]:
    """Return a process and all that it started."""
    found = [pid]
    for one in Path("/proc").glob("[0-9]*/stat"):
        with suppress(FileNotFoundError, ProcessLookupError):
            if int(one.read_text().rpartition(")")[2].split()[1]) == pid:
                found += family(int(one.parent.name))
    return found


def server_of(url: str) -> int:
    """Return the process of a PostgreSQL server on this machine."""
    with psycopg.connect(url) as connection:
        backend = connection.info.backend_pid
    for one in (backend, *(int(p.name) for p in Path("/proc").glob("[0-9]*"))):
        with suppress(FileNotFoundError, ProcessLookupError):
            if "postgres" in Path(f"/proc/{one}/comm").read_text():
                arguments = Path(f"/proc/{one}/cmdline").read_bytes().decode().split("\0")
                if url.rpartition("host=")[2] in arguments:
                    return one
    raise RuntimeError("no server")


@contextmanager
def empty_store() -> Iterator[str]:
    """Yield the URL of a server's database, emptied; the server waits for the disk as it should."""
    url = postgres_server.url(postgres_server.CLOSED)
    assert url is not None, "PostgreSQL is not installed"
    with psycopg.connect(url, autocommit=True) as connection:
        connection.execute("DROP SCHEMA public CASCADE")
        connection.execute("CREATE SCHEMA public")
    yield url


def wait(condition: Callable[[], object], every_s: float = 0.2) -> None:
    """Wait until something holds, an hour at most."""
    last_s = time.monotonic() + 3600
    while not condition():
        assert time.monotonic() < last_s, "too slow"
        time.sleep(every_s)


# monitors


def send(port: int, trip: Path, names: Sequence[str], times: float) -> None:
    """Send the frames of a trip for each suspension, so many times faster than in real time."""
    by_second: dict[int, list[Template]] = {}
    frames = list(Replay(trip).frames())
    for one in frames:
        by_second.setdefault((one.time_ns - frames[0].time_ns) // 10**9, []).append(Template(one))
    sender = Sender(Broker(port=port), in_flight=1000)
    places = [f"train {name}, {frames[0].suspension}" for name in names]
    begin_s = time.monotonic()
    for second, templates in sorted(by_second.items()):
        time.sleep(max(0.0, begin_s + second / times - time.monotonic()))
        for place in places:
            for one in templates:
                sequence = 10**6 + one.frame.sequence
                sender.give(place, one.filled(place.encode(), one.frame.time_ns, sequence))
    sender.close()


def monitors(run: Path, trip: Path, n_monitors: int, n_suspensions: int, times: float) -> None:
    """Print what each program needs for the frames of a section of each suspension."""
    with tempfile.TemporaryDirectory() as name, empty_store() as url:
        folder, names = Path(name), [f"{k:06d}" for k in range(n_suspensions)]
        content = yaml.safe_load(next(trip.glob("*.yaml")).read_text())
        for one in names:
            (folder / "manifests" / one).mkdir(parents=True)
            manifest = yaml.safe_dump(content | {"train": one})
            (folder / "manifests" / one / "trip.yaml").write_text(manifest)
        (folder / "broker").mkdir()
        broker = Mosquitto(folder / "broker").start()
        common = [f"run={run}", f"suspensions={folder}/manifests", f"store='{url}'", "source=mqtt"]
        common += [f"source.broker.port={broker.port}", "live.idle_s=30"]
        pids = []
        for k in range(1, n_monitors + 1):
            (where := folder / str(k)).mkdir()
            part = f"source.part={k}/{n_monitors}"
            pids.append(start("monitor", [*common, part, "journal=journal"], where))
        log = folder / "broker" / "mosquitto.log"
        wait(lambda: log.read_text().count("as suspnet-monitor-") == n_monitors)
        time.sleep(5)
        server = family(server_of(url))
        written_mib = sum(map(disk_mib, pids))
        before = cpu_s(pids), cpu_s([broker.process.pid]), cpu_s(server)
        memory = sum(map(memory_mib, pids))
        sender = os.fork()
        if not sender:
            send(broker.port, trip, names, times)
            os._exit(0)
        with psycopg.connect(url, autocommit=True) as connection:
            query = "SELECT status, count(*) FROM trips GROUP BY status"
            wait(lambda: sum(n for _, n in connection.execute(query)) == n_suspensions, 5.0)
            assert ended(sender, 60) == 0
            time.sleep(30)
            statuses = dict(connection.execute(query).fetchall())
        server = family(server[0])
        after = cpu_s(pids), cpu_s([broker.process.pid]), cpu_s(server)
        monitor_s, broker_s, server_s = (b - a for a, b in zip(before, after, strict=True))
        grown = (sum(map(memory_mib, pids)) - memory) / n_suspensions
        written_mib = sum(map(disk_mib, pids)) - written_mib
        for pid in pids:
            os.kill(pid, signal.SIGTERM)
            ended(pid, 60)
        broker.end()
    signal_s = n_suspensions * SECTION_S
    print(
        f"{n_monitors} monitors, {n_suspensions} suspensions ({statuses}): "
        f"{1e3 * monitor_s / signal_s:.3f} ms of monitors, "
        f"{1e3 * broker_s / signal_s:.3f} ms of the broker "
        f"({1e6 * broker_s / signal_s / FRAMES_S:.0f} us a frame) for a second of a suspension, "
        f"{1e3 * server_s / n_suspensions:.0f} ms of PostgreSQL for a section; "
        f"{memory / n_monitors:.0f} MiB a monitor and {grown:.1f} MiB a suspension; "
        f"{1024 * written_mib / signal_s:.0f} KiB/s of a suspension to the disk\n"
        f"  {N_FLEET} suspensions: {N_FLEET * monitor_s / signal_s:.1f} cores of monitors, "
        f"{N_FLEET * broker_s / signal_s:.2f} of brokers, "
        f"{N_FLEET * grown / 1024:.0f} GiB; {N_FLEET * FRAMES_S} frames/s",
        flush=True,
    )


# writers


def write(
    url: str, run: Path, trip: Path, k: int, n_before: int, n_trips: int, folder: Path
) -> None:
    """Store trips one at a time as a monitor does, and the processor and wall time for one [ms]."""
    model = load_model(run)
    result = evaluate_trip(next(trip.glob("*.yaml")), [model], TripSettings())
    assert result.status == "ok", result.reason
    place, rng = Place("x", train=str(k)), np.random.default_rng(k)
    many = [
        replace(
            result,
            place=place,
            mileage_km=10.0 * i,
            start=f"2026-01-{1 + i % 28:02d}",
            trip=str(i),
            estimates={name: 1 + 0.003 * rng.normal() for name in result.estimates},
        )
        for i in range(n_before + 1 + n_trips)
    ]

    def store_one(one: TripResult) -> None:
        keep_trips([one], place, [model], DEFAULT_LIMITS, ChangeSettings(), store)

    with History(url) as store:
        store.write(many[:n_before])
        store_one(many[n_before])  # a program's first one compiles statements, simulates thresholds
        (folder / f"{k} ready").touch()
        wait((folder / "go").exists, 0.001)
        begin = time.process_time(), time.perf_counter()
        for one in many[n_before + 1 :]:
            store_one(one)
        spent_s, wall_s = time.process_time() - begin[0], time.perf_counter() - begin[1]
    (folder / f"{k} done").write_text(f"{1e3 * spent_s / n_trips} {wall_s}")


def writers(run: Path, trip: Path, kind: str, n_writers: int, n_before: int, n_trips: int) -> None:
    """Print what storing trips takes when several programs do it at once."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, server = Path(name), 0
        url = str(folder / "fleet.db")
        if kind == "postgresql":
            url = stack.enter_context(empty_store())
            server = server_of(url)
        pids = []
        for k in range(n_writers):
            pids.append(os.fork())
            if not pids[-1]:
                write(url, run, trip, k, n_before, n_trips, folder)
                os._exit(0)
        wait(lambda: len(list(folder.glob("* ready"))) == n_writers)
        before_s = cpu_s(family(server)) if server else 0.0
        (folder / "go").touch()
        wait(lambda: len(list(folder.glob("* done"))) == n_writers, 0.01)
        server_s = cpu_s(family(server)) - before_s if server else 0.0
        assert all(ended(pid, 60) == 0 for pid in pids)
        texts = [(folder / f"{k} done").read_text() for k in range(n_writers)]
        spent_ms, wall_s = zip(*(map(float, text.split()) for text in texts), strict=True)
    n_all = n_writers * n_trips
    print(
        f"{kind}, {n_writers} writers, {n_before} trips before: {np.mean(spent_ms):.1f} ms of the "
        f"writer and {1e3 * server_s / n_all:.1f} ms of the server for a trip; "
        f"{n_all / max(wall_s):.1f} trips/s together",
        flush=True,
    )


# evaluation


def evaluate(run: Path, trips: Path, n_workers: int) -> None:
    """Print the processor time of the evaluation of a folder by local processes."""
    with tempfile.TemporaryDirectory() as name:
        folder, begin_s = Path(name), time.monotonic()
        arguments = [f"run={run}", f"trips={trips}", f"monitor.workers={n_workers}"]
        arguments += ["figures=false", "progress=false", "hydra.run.dir=out"]
        pid = start("evaluate", arguments, folder)
        spent_s = 0.0
        while (code := ended(pid, 0.5)) is None:
            spent_s = max(spent_s, cpu_s(family(pid)))
        assert code in (0, 2, 3, 4), (folder / "output.log").read_text()
        wall_s = time.monotonic() - begin_s
    print(
        f"{n_workers} processes: {spent_s:.1f} s of the program with its processes, "
        f"{wall_s:.0f} s of wall time",
        flush=True,
    )


def main() -> None:
    """Measure, and print a line for each case."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("trips", type=Path)
    parser.add_argument("what", choices=("monitors", "writers", "evaluate"))
    parser.add_argument("--counts", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--suspensions", type=int, default=24)
    parser.add_argument("--times", type=float, default=2.0)
    parser.add_argument("--before", type=int, nargs="+", default=[100, 1000, 3000])
    parser.add_argument("--stores", nargs="+", default=["sqlite", "postgresql"])
    parser.add_argument("--stored", type=int, default=100, help="trips that a writer stores")
    given = parser.parse_args()
    run, trips = given.run.absolute(), given.trips.absolute()
    for name in ("monitor", "evaluate"):
        import_module(f"suspnet.cli.{name}")
    for n in given.counts:
        if given.what == "monitors":
            monitors(run, trips, n, given.suspensions, given.times)
        elif given.what == "writers":
            for kind, n_before in product(given.stores, given.before):
                writers(run, trips, kind, n, n_before, given.stored)
        else:
            evaluate(run, trips, n)


if __name__ == "__main__":
    main()
