"""The file of a vehicle to be filled in: each number with what it is and where it is found."""

import os
import re
from collections.abc import Sequence
from pathlib import Path

from suspnet.ground.settings import settings_of
from suspnet.ground.storage import printable, write_atomically
from suspnet.ground.wording import command
from suspnet.vehicle.vehicle import Vehicle

NAME = re.compile(r"[A-Za-z_][\w.-]{0,99}", re.ASCII)
FILL_IN = "???"
"""Value of a number that the user has to give, as Hydra marks it."""
SPRING = "within some 20 %, which healthy trips correct (commissioning)"
DAMPER = "within some 40 %, which healthy trips correct (commissioning)"
LENGTH = "within some 5 %, which healthy trips correct (commissioning)"
GYRATION = "sqrt(moment of inertia / mass), within some 15 %; if unknown"
FORM = {
    "bogie_mass_kg": (FILL_IN, "Drawing: half of a bogie frame; 20 % off changes M_s by as much"),
    "body_mass_kg": (FILL_IN, "Drawing: a quarter of the body; M_s is relative to it"),
    "primary_stiffness_n_per_m": (
        FILL_IN,
        f"Drawing or data sheet: sum of the springs of both axle boxes of the side, {SPRING}",
    ),
    "primary_damping_ns_per_m": (
        FILL_IN,
        f"Data sheet: sum of the dampers of both axle boxes of the side, {DAMPER}",
    ),
    "secondary_stiffness_n_per_m": (
        FILL_IN,
        f"Drawing or data sheet: the springs of the side, {SPRING}",
    ),
    "secondary_damping_ns_per_m": (
        FILL_IN,
        f"Data sheet: the vertical dampers of the side, {DAMPER}",
    ),
    "half_wheelbase_m": (FILL_IN, f"Drawing: half of the bogie's wheelbase, {LENGTH}"),
    "half_pivot_distance_m": (FILL_IN, f"Drawing: half the distance of the pivots, {LENGTH}"),
    "bogie_gyration_m": (FILL_IN, f"{GYRATION}, 0.59 of half_wheelbase_m as of the AM96"),
    "body_gyration_m": (FILL_IN, f"{GYRATION}, 0.82 of half_pivot_distance_m as of the AM96"),
    "source": ('""', "The drawing's number"),
}
"""Value in the file, and where each number is found and how exact it must be."""


def write_vehicle(name: str, paths: Sequence[Path], words: Sequence[str], force: bool) -> int:
    """Write DIR/vehicle/NAME.yaml with marks where numbers are to be filled in, and return 0.

    ValueError if the name is wrong, or the file exists and is not replaced.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"--vehicle must be a plain name without blanks, got {name!r}")
    if len(paths) > 1 or words:
        raise ValueError("give the folder of vehicles alone: numbers are filled in in the file")
    path = (paths[0] if paths else Path("vehicles")) / "vehicle" / f"{name}.yaml"
    if os.path.lexists(path) and not force:
        raise ValueError(f"{path} exists; --force replaces it")
    lines = [f"# {name}: numbers are SI and of one bogie side; fill in each {FILL_IN}"]
    lines.append(f"name: {name}")
    for key, declared in settings_of(Vehicle).items():
        if key in FORM:
            value, source = FORM[key]
            setting = declared.setting
            sentence = re.sub(r"; .*", "", setting.sentence)
            lines += ["", f"# {sentence} [{setting.unit or setting.rule or 'share'}]"]
            lines += [f"# {source}", f"{key}: {value}"]
    write_atomically(path, "\n".join(lines) + "\n", force=force)
    option = "--config-dir", path.parents[1]
    print(
        printable(
            f"-> {path}: fill in each {FILL_IN}\nuse it: {command('check', 'DIR', *option)}\n"
            f"        {command('train', *option, f'vehicle={name}')} ..."
        )
    )
    return 0
