"""Files as the loggers of a depot write them, of two bogies whose parts are known.

python benchmarks/depot_files.py DIR [--seed 11] [--minutes 16]

A train of tests/blind_train.py makes eight speeds and loads, both ways. Its leading bogie writes 16
CSV files as a German logger does, in g and m/s2; a damper of it fades. The sensors of its trailing
bogie are above its rear axle, written as 10 MDF4 files (asammdf). Both meet a fault: a loose cable
and a swapped pair on the leading one, a dead sensor on the trailing one. `fahrtenbuch.csv` is the
depot's table of the trips, `truth.yaml` what is to be found; hand out all but the latter.
"""

import sys
from argparse import ArgumentParser
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import yaml
from asammdf import MDF, Signal

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from blind_train import COMPONENTS, Run, Track, Train, record

RATE_HZ = 500.0
SPEEDS = (70.0, 62.0, 55.0, 76.0, 48.0, 66.0, 73.0, 59.0)
LOADS = (1.0, 1.12, 0.96, 1.05, 1.0, 1.2, 1.08, 0.92)
DAMPER = "c_p_axle2_left"
FADED = (95, 90, 85, 80, 75, 70, 62, 55)  # % on the leading bogie's later trips
N_HEALTHY, N_TRAILING = 8, 10
LOOSE, DEAD, SWAPPED = 11, 6, 13  # trips with a fault
LEFT_AND_RIGHT = ("AL1_L", "AL1_R", "DG_L", "DG_R", "WK_L", "WK_R")
G = 9.80665
FIRST = datetime(2026, 8, 3, 5, 12, 40)


def main():
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--minutes", type=float, default=16.0)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    train = Train.scattered(options.seed, geometry=0.0, sensors=True)
    rng = np.random.default_rng(options.seed)
    rows, truth = ["Datei;Datum;Kilometerstand;Fahrtrichtung;Geschwindigkeit [km/h]"], {}
    for i in range(N_HEALTHY + len(FADED)):
        wear = FADED[i - N_HEALTHY] if i >= N_HEALTHY else 100
        ratios = np.ones(13)
        ratios[COMPONENTS.index(DAMPER)] = wear / 100
        signals, run = trip(train, ratios, i, options, rng)
        name = f"DG1_{i + 1:02d}.csv"
        if i == LOOSE:
            loosen(signals[2], rng)
        if i == SWAPPED:
            signals[[0, 1]] = signals[[1, 0]]
        km, start = written(rows, name, run, i)
        write_csv(options.folder / name, signals, start, km)
        truth[name] = {DAMPER: wear}
    for i in range(N_TRAILING):
        signals, run = trip(train, np.ones(13), i, options, rng, trailing=True)
        name = f"DG2_{i + 1:02d}.mf4"
        if i == DEAD:
            signals[5] = 0.0
        _, start = written(rows, name, run, i)
        write_mdf(options.folder / name, signals, start)
        truth[name] = {}
    (options.folder / "fahrtenbuch.csv").write_text("\n".join(rows) + "\n", encoding="latin-1")
    faults = {"loose": LOOSE + 1, "swapped": SWAPPED + 1, "dead": DEAD + 1}
    numbers = {
        "half_wheelbase_m": train.half_wheelbase_m,
        "half_pivot_m": train.half_pivot_m,
        "body_kg": train.body_kg,
        "frame_kg": train.frame_kg,
        "wheelset_kg": train.wheelset_kg,
    }
    text = yaml.safe_dump({"percent": truth, "faults": faults, "numbers": numbers})
    (options.folder / "truth.yaml").write_text(text)


def trip(train, ratios, i, options, rng, trailing=False):
    """Return the signals of a trip and how it was made; a trailing bogie is a train turned."""
    direction = "reverse" if i % 3 == 1 else "forward"
    run = Run(SPEEDS[i % 8], direction, options.minutes, alone_share=0.01, rate_hz=RATE_HZ)
    one = train.worn([*ratios[:12], LOADS[i % 8]])
    if trailing:
        one = replace(one.turned(), sensitivity=train.sensitivity[::-1])
        run = replace(run, direction="forward" if direction == "reverse" else "reverse")
    signals = record(one, Track.drawn(rng), run, int(rng.integers(2**31)))
    if trailing:  # what is left of the turned train is right of the train
        signals = signals[[1, 0, 3, 2, 5, 4]]
    return signals, replace(run, direction=direction)


def loosen(signal, rng):
    """Let a cable lose its contact ten times for 4 to 20 s: steps, spikes, and nothing else."""
    for start in rng.choice(len(signal) - round(30 * RATE_HZ), 10, replace=False):
        n = round(rng.uniform(4, 20) * RATE_HZ)
        signal[start : start + n] = 30 * (rng.random(n) < 0.01) - 9.81 * rng.random()


def written(rows, name, run, i):
    """Add a trip to the table, and return its mileage and start."""
    km, start = 297_000 + 1_900 * i, FIRST + timedelta(days=2 * i, minutes=7 * i)
    way = {"forward": "vorwärts", "reverse": "rückwärts"}[run.direction]
    speed = f"{3.6 * run.speed_m_per_s:.1f}".replace(".", ",")
    rows.append(f"{name};{start:%d.%m.%Y %H:%M};{km};{way};{speed}")
    return km, start


def write_csv(path, signals, start, km):
    """Write semicolons, decimal commas, Latin-1, lines of the logger above; bogie and body in g."""
    n = signals.shape[1]
    times = np.datetime64(start, "ms") + (1000 / RATE_HZ * np.arange(n)).astype("timedelta64[ms]")
    stamps = [f"{t[8:10]}.{t[5:7]}.{t[:4]} {t[11:19]},{t[20:23]}" for t in times.astype(str)]
    units = ["m/s²"] * 2 + ["g"] * 4
    values = signals.copy()
    values[2:] /= G
    head = [
        "Gerät;MesSys 4",
        "Fahrzeug;417 003",
        f"Kilometerstand;{km}",
        f"Start;{start:%d.%m.%Y %H:%M:%S}",
        f"Abtastrate;{RATE_HZ:.0f} Hz",
        "Zeit;" + ";".join(f"{c} [{u}]" for c, u in zip(LEFT_AND_RIGHT, units, strict=True)),
    ]
    with path.open("w", encoding="latin-1") as file:
        file.write("\n".join(head) + "\n")
        for stamp, row in zip(stamps, values.T, strict=True):
            file.write(stamp + ";" + ";".join(f"{v:.5f}".replace(".", ",") for v in row) + "\n")


def write_mdf(path, signals, start):
    """Write one group of six signals in m/s2 with the time of the start."""
    times = np.arange(signals.shape[1]) / RATE_HZ
    names = [c.replace("AL1", "AL4") for c in LEFT_AND_RIGHT]
    found = [
        Signal(values.astype(np.float32), times, unit="m/s2", name=name)
        for name, values in zip(names, signals, strict=True)
    ]
    with MDF(version="4.10") as file:
        file.start_time = start
        file.append(found)
        file.save(path, overwrite=True)


if __name__ == "__main__":
    main()
