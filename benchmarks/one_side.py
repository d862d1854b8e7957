"""Read README's demonstration by all sensors, and by those of one side alone.

python benchmarks/one_side.py FOLDER

FOLDER is that in which the three commands at the top of docs/parts.md were run. The trips get
manifests with the sensors of the left side alone and of the right side alone, from which vehicles
are commissioned and the trips read. Runs that FOLDER holds already are taken. Writes one_side.csv:
what each reading says of the damper that fades.
"""

import csv
import subprocess
import sys
from pathlib import Path

import yaml
from cells import Parser

from suspnet.cli.folders import ACT

ROOT = Path(__file__).resolve().parents[1]
RESULTS = Path(__file__).parent / "results"
PART = "c_p_axle2_left"
SIDES = ("left", "right")


def one_sided(source: Path, folder: Path, side: str) -> None:
    """Write the manifests of a folder's trips with the sensors of one side."""
    folder.mkdir()
    for path in sorted(source.glob("trip_*.yaml")):
        content = yaml.safe_load(path.read_text())
        for place, sensors in content["channels"].items():
            (content["channels"][place],) = (one for one in sensors if one["side"] == side)
        content |= {"suspension": side, "truth": {}}
        (folder / path.name).write_text(yaml.safe_dump(content, sort_keys=False))
        (folder / path.stem).symlink_to(source / path.stem)


def run(folder: Path, *command: str, most: int = 0) -> None:
    """Run a program; RuntimeError if its exit code is above `most`."""
    code = subprocess.run([sys.executable, *command], cwd=folder, check=False).returncode
    if not 0 <= code <= most:
        raise RuntimeError(f"{' '.join(command)} ended with {code}")


def rows_of(folder: Path, name: str) -> dict[str, dict[str, str]]:
    """Return the rows of the trips of the newest evaluation, by trip."""
    found = sorted(folder.glob(f"outputs/evaluate/*trips_{name}*/trips.csv"))[-1]
    with found.open(newline="") as file:
        return {row["trip"]: row for row in csv.DictReader(file)}


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, help="in which the commands of docs/parts.md were run")
    folder = parser.parse_args().folder.resolve()
    for side in SIDES:
        if list(folder.glob(f"outputs/evaluate/*trips_{side}*")):
            continue
        one_sided(folder / "trips" / "parts", folder / "trips" / side, side)
        model, trips = f"outputs/{side}", f"trips/{side}"
        options = [f"healthy={trips}", "n_healthy=4", f"hydra.run.dir={model}"]
        run(folder, str(ROOT / "train.py"), "experiment=trips", *options)
        run(folder, str(ROOT / "evaluate.py"), f"trips={trips}", f"run={model}", most=ACT)
    every = {name: rows_of(folder, name) for name in ("parts", *SIDES)}
    with (RESULTS / "one_side.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["trip", "truth", "reading", "estimate", "low", "high"])
        for trip, row in every["parts"].items():
            for name, rows in every.items():
                found = [rows[trip][f"{PART}{end}"] for end in ("", "_low", "_high")]
                writer.writerow([trip, row[f"{PART}_truth"], name, *found])


if __name__ == "__main__":
    main()
