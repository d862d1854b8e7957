"""Kills programs at random moments, looks at what is left, and lets them go on to the end.

python benchmarks/fault_injection.py FOLDER N_KILLS SEED [PROGRAM ...]    prints the counts as JSON

The programs run as forks of this process, which has imported all that they need: in two of three
starts the moment of the kill would else fall into the import of torch.
"""

import json
import os
import random
import shutil
import signal
import sys
import time
from collections import Counter
from importlib import import_module
from pathlib import Path

import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import yaml
from PIL import Image

from suspnet.cli import program
from suspnet.ground.storage import read_arrays, read_json
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.trips.earlier import FOLDER

RATES_HZ = (400.0, 250.0, 250.0)
FEW = [
    *("data.n_train=300", "data.n_test=100", "data.n_calibrate=100"),
    *("progress=false", "threads=1", "model=linear"),
]
SWEEP = ["-m", "seed=0,1", "figures=false", *FEW]
MODEL = [
    *("experiment=trips", "data.minutes=5", "data.rates_hz=[400,250,250]", *FEW),
    *("model=msvr", "model.feature_map=nystroem", "model.n_components=128", "figures=false"),
]
SIMULATE = [
    *("out=trips", "fleet.minutes=1", "progress=false", "generator=best", "scatter=0"),
    *(f"fleet.sensors.{n}.rate_hz={r:g}" for n, r in zip(CHANNELS, RATES_HZ, strict=True)),
]
EVALUATE = ["run=../model", "trips=../trips", "progress=false"]
PROGRAMS = {
    "train": ("train", [*FEW, "hydra.run.dir=run"], [*FEW, "resume=run"]),
    "sweep": ("train", [*SWEEP, "hydra.sweep.dir=run"], [*SWEEP, "resume=run"]),
    "joblib": (
        "train",
        [*SWEEP, "hydra.sweep.dir=run", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
        [*SWEEP, "resume=run", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"],
    ),
    "simulate": ("simulate", [*SIMULATE, "fleet.n_trips=6", "workers=2"], None),
    "simulate alone": ("simulate", [*SIMULATE, "fleet.n_trips=4", "workers=1"], None),
    "evaluate": (
        "evaluate",
        [*EVALUATE, "monitor.workers=2", "hydra.run.dir=run"],
        [*EVALUATE, "monitor.workers=2", "resume=run"],
    ),
}
"""Of each program: its name, how it begins, and how it goes on (None: as it begins)."""
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
IN_A_ROW = 3
"""Number of kills after which a program may go on to its end."""
END_S, ORPHANS_S, LONGEST_S = 30.0, 10.0, 300.0
"""Longest time to the end after a signal, to the end of the last worker, and of a whole run [s]."""


def start(name, arguments, folder):
    """Start a program in a session of its own and return its process."""
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setsid()
        os.chdir(folder)
        output = os.open("output.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        for stream in (1, 2):
            os.dup2(output, stream)
        sys.argv = [f"{name}.py", *arguments]
        program.main(name)
        code = 0
    except SystemExit as ended:
        if isinstance(ended.code, str):
            print(ended.code, file=sys.stderr)
        code = ended.code if isinstance(ended.code, int) else int(ended.code is not None)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def ended(pid, seconds):
    """Wait for the end of a process, at most so long; return its exit code, or None."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        found, status = os.waitpid(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.01)
    return None


def session(pid):
    """Return the processes of a session that are alive."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, leader = path.read_text().rpartition(")")[2].split()[:4]
        except (FileNotFoundError, ProcessLookupError):
            continue
        if int(leader) == pid and state != "Z":
            found.append(int(path.parent.name))
    return found


def is_whole(path):
    """Return whether a file is as it was meant to be."""
    try:
        match path.suffix:
            case ".json":
                read_json(path)
            case ".yaml":
                assert isinstance(yaml.safe_load(path.read_text()), dict)
            case ".parquet":
                pq.read_table(path)
            case ".csv":
                pacsv.read_csv(path)
            case ".safetensors":
                read_arrays(path)  # none of a trip without an estimate
            case ".png":
                with Image.open(path) as image:
                    image.load()
            case ".html":
                assert path.read_text().rstrip().endswith("</html>")
            case ".md" | ".txt":
                assert path.read_text().endswith("\n")
            case _:
                assert not path.name.startswith(".")
    except Exception as error:
        print(f"half-written: {path}: {error!r}", file=sys.stderr)
        return False
    return True


def files(folder):
    """Return the files that the programs, not Hydra or TensorBoard, wrote."""
    skipped = (".log", "multirun.yaml")
    return [
        path
        for path in folder.rglob("*")
        if path.is_file()
        and ".hydra" not in path.parts
        and not path.name.endswith(skipped)
        and "tfevents" not in path.name
    ]


def finished(folder):
    """Return what was done with: each finished job, trip and evaluated trip, with its bytes."""
    done = [*folder.rglob("metrics.json"), *folder.rglob("trip_*.yaml")]
    done += folder.rglob(f"{FOLDER}/*.safetensors")
    return {path: path.read_bytes() for path in done if path.parent != folder / "run"}


def result(folder):
    """Return what a program found, without times and paths."""
    found = {}
    for path in files(folder):
        name = str(path.relative_to(folder))
        if "trips" in path.parts[-3:] and path.suffix in (".yaml", ".parquet", ".json"):
            found[name] = path.read_bytes()
        if path.name == "metrics.json":
            keys = ("scores", "rms_percent", "n_estimated", "severity", "verdict", "seed")
            content = read_json(path)
            found[name] = {key: content[key] for key in keys if key in content}
        if path.name == "trips.csv":
            rows = pacsv.read_csv(path).drop_columns(["seconds", "manifest"]).to_pylist()
            found[name] = repr(rows)
        if path.name == "model.safetensors":
            found[name] = path.read_bytes()
    return found


def prepare(folder):
    """Write a model and trips for the evaluation."""
    for name, arguments, output in (
        ("train", [*MODEL, "hydra.run.dir=model"], "model"),
        ("simulate", [*SIMULATE, "fleet.n_trips=4", "workers=1"], "trips"),
    ):
        if not (folder / output).exists():
            assert ended(start(name, arguments, folder), LONGEST_S) == 0, arguments


def whole(name, folder):
    """Run a program without a kill; return what it found and how long it took [s]."""
    program_name, arguments, _ = PROGRAMS[name]
    folder.mkdir()
    begin = time.monotonic()
    code = ended(start(program_name, arguments, folder), LONGEST_S)
    assert code is not None
    assert code in (0, 2, 3, 4), (folder / "output.log").read_text()
    return result(folder), time.monotonic() - begin


def inject(name, folder, n_kills, rng, counts):
    """Kill a program some times, a few in a row, and let it go on to its end."""
    program_name, begin, go_on = PROGRAMS[name]
    expected, seconds = whole(name, folder / f"{name} whole")
    where, before, over = folder / name, {}, False
    for number in range(n_kills):
        if number % IN_A_ROW == 0 or over:
            shutil.rmtree(where, ignore_errors=True)
            where.mkdir()
            before = {}
        again = go_on if go_on and (where / "run").is_dir() else begin
        pid = start(program_name, again, where)
        sent = rng.choice(SIGNALS)
        code = ended(pid, rng.uniform(0, seconds))
        if code is None:
            os.kill(pid, sent)
            counts["kills"] += 1
            counts[f"{name}: {signal.Signals(sent).name}"] += 1
            code = ended(pid, END_S)
            right = {signal.SIGKILL: -9, signal.SIGTERM: 143, signal.SIGINT: 130}[sent]
            counts["other exit codes"] += code not in (right, 0, 2)
            if code is None:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
        over = go_on is None and code == 0  # a finished fleet is refused, not written again
        last = time.monotonic() + ORPHANS_S
        while session(pid) and time.monotonic() < last:
            time.sleep(0.05)
        counts["orphans"] += len(session(pid))
        counts["half-written"] += sum(not is_whole(path) for path in files(where))
        now = finished(where)
        counts["lost"] += sum(now.get(path) != content for path, content in before.items())
        before = now
        if number % IN_A_ROW == IN_A_ROW - 1 or number == n_kills - 1:
            again = go_on if go_on and (where / "run").is_dir() else begin
            trips = where / "trips"
            if not any(trips.glob("*.yaml")) or (trips / "unfinished.json").exists():
                code = ended(start(program_name, again, where), LONGEST_S)
                counts["did not go on"] += code not in (0, 2, 3, 4)
            now = finished(where)
            counts["lost"] += sum(now.get(path) != content for path, content in before.items())
            counts["resumed"] += 1
            counts["other results"] += result(where) != expected
        output = (where / "output.log").read_text()
        if "Traceback" in output:
            counts["tracebacks"] += 1
            print(output, file=sys.stderr)


def main(folder, n_kills, seed, names):
    rng, counts = random.Random(seed), Counter()
    folder.mkdir(parents=True, exist_ok=True)
    needed = ["train", "simulate"] if "evaluate" in names else []
    for name in {*needed, *(PROGRAMS[name][0] for name in names)}:
        import_module(f"suspnet.cli.{name}")
    if "evaluate" in names:
        prepare(folder)
    for i, name in enumerate(names):
        share = n_kills * (i + 1) // len(names) - n_kills * i // len(names)
        inject(name, folder, share, rng, counts)
        print(name, dict(counts), file=sys.stderr, flush=True)
    print(json.dumps(counts))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), sys.argv[4:] or list(PROGRAMS))
