"""The file of a vehicle from a short form: each number with what it is and where it is from."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from suspnet.ground.settings import Declared, settings_of
from suspnet.ground.storage import printable, write_atomically
from suspnet.ground.wording import command
from suspnet.vehicle.quantities import QUANTITIES
from suspnet.vehicle.vehicle import GEOMETRY, Vehicle

FOLDER = Path("vehicles")
"""Folder of the vehicles if none is given."""
NAME = re.compile(r"\w[\w.-]{0,99}", re.ASCII)
PRIORS = {
    "primary_stiffness_n_per_m": "healthy_k_p",
    "primary_damping_ns_per_m": "healthy_c_p",
    "secondary_stiffness_n_per_m": "healthy_k_s",
    "secondary_damping_ns_per_m": "healthy_c_s",
    **{name: name.removesuffix("_m") for name in GEOMETRY},
}
"""Name among the uncertain numbers of each number that commissioning corrects."""
FROM = {
    "bogie_mass_kg": "drawing: half of a bogie frame",
    "body_mass_kg": "drawing: a quarter of the body",
    "primary_stiffness_n_per_m": "drawing or data sheet: sum of the springs of both axle boxes of "
    "the side",
    "primary_damping_ns_per_m": "data sheet: sum of the dampers of both axle boxes of the side",
    "secondary_stiffness_n_per_m": "drawing or data sheet: the springs of the side",
    "secondary_damping_ns_per_m": "data sheet: the vertical dampers of the side",
    "half_wheelbase_m": "drawing: half of the bogie's wheelbase",
    "half_pivot_distance_m": "drawing: half of the distance between the pivots",
    "bogie_gyration_m": "sqrt(moment of inertia / mass); without it 0.59 of the half wheelbase, as "
    "of the AM96",
    "body_gyration_m": "sqrt(moment of inertia / mass); without it 0.82 of the half pivot distance",
    "primary_friction_share": "kind of springs: 0 for coil springs and hydraulic dampers",
    "primary_blow_off_m_per_s": "data sheet of the damper; null if linear",
    "secondary_blow_off_m_per_s": "data sheet of the damper; null if linear or a choke",
    "source": "the drawing's number",
}
"""Where each number is found, and what it is the sum of."""
GUESSED = {
    "bogie_gyration_m": ("half_wheelbase_m", 0.8 / 1.35),
    "body_gyration_m": ("half_pivot_distance_m", 7.8 / 9.5),
}
"""Radii of gyration without a value, as shares of a length: those of the AM96's file."""
LITTLE = {
    "bogie_mass_kg": "matters little: 20 % off changes no estimate of springs and dampers relative "
    "to healthy, and that of M_s by as much"
}
"""Numbers that matter little for estimates relative to healthy, and why."""


@dataclass(frozen=True)
class Entry:
    """A number of the form: its setting, and how exact it must be."""

    setting: Declared
    exactness: str

    @property
    def name(self) -> str:
        """Key of the number."""
        return self.setting.name

    @property
    def is_required(self) -> bool:
        """Whether a vehicle needs it."""
        lengths = ("half_wheelbase_m", "half_pivot_distance_m")
        return self.name in lengths or self.name.endswith(("_kg", "n_per_m", "ns_per_m"))


def entries() -> list[Entry]:
    """Return the numbers of a vehicle, in the order of its file."""
    deviations = {setting.name: setting.deviation for setting in QUANTITIES}
    form = []
    for name, setting in settings_of(Vehicle).items():
        if name in FROM:
            exact = LITTLE.get(name, "")
            if name in PRIORS:
                share = deviations[PRIORS[name]]
                exact = f"within some {share:.0%}: healthy trips correct it (commissioning)"
            elif name == "body_mass_kg":
                exact = "as exact as known: M_s is relative to it"
            form.append(Entry(setting, exact))
    return form


def write_vehicle(name: str, paths: Sequence[Path], words: Sequence[str], force: bool) -> int:
    """Write DIR/vehicle/NAME.yaml from KEY=VALUE and return 0; 1 if numbers are missing.

    ValueError if the name, a key or a value is wrong, or the file exists and is not replaced.
    """
    if not NAME.fullmatch(name):
        raise ValueError(f"--vehicle must be a plain name without blanks, got {name!r}")
    if len(paths) > 1:
        raise ValueError(f"give one folder of vehicles, not {len(paths)}")
    path = (paths[0] if paths else FOLDER) / "vehicle" / f"{name}.yaml"
    if os.path.lexists(path) and not force:
        raise ValueError(f"{path} exists; --force replaces it")
    # all that is missing is listed at once, with where to find it
    form = entries()
    values = _read(words, form)
    lacking = [entry for entry in form if entry.name not in values]
    if any(entry.is_required for entry in lacking):
        print(f"{path} is not written yet; give these of one bogie side, in SI units, KEY=VALUE:")
        for entry in lacking:
            if entry.is_required:
                print(f"  {entry.name} [{entry.setting.setting.unit}]: {FROM[entry.name]}")
                print(f"      {entry.exactness}")
        optional = [entry.name for entry in lacking if not entry.is_required]
        print(f"may be left out: {', '.join(optional)}")
        return 1
    # what hardly matters is assumed, and said
    guessed = {
        key: round(share * float(values[of]), 3)
        for key, (of, share) in GUESSED.items()
        if key not in values
    }
    vehicle = Vehicle(name=name, **(values | guessed))
    write_atomically(path, _text(name, form, values, guessed), force=force)
    for key, value in guessed.items():
        print(f"{key}: {value:g}, assumed as a share of {GUESSED[key][0]}")
    print(*_as_built(vehicle), sep="\n")
    option = "--config-dir", path.parents[1]
    print(
        printable(
            f"-> {path}\nuse it: {command('check', 'DIR', *option)}\n"
            f"        {command('train', *option, f'vehicle={name}')} ..."
        )
    )
    return 0


def _as_built(vehicle: Vehicle) -> list[str]:
    """Return what the numbers of one bogie side are on the whole vehicle, for a look at them."""
    k_p, c_p, k_s, c_s = vehicle.healthy_values()[:4]
    return [
        "that is, to be compared with the drawing:",
        f"  car body {4 * vehicle.body_mass_kg:,.0f} kg, each bogie frame "
        f"{2 * vehicle.bogie_mass_kg:,.0f} kg",
        f"  each axle box {k_p / 2:,.0f} N/m and {c_p / 2:,.0f} N s/m, each side of a bogie "
        f"{k_s:,.0f} N/m and {c_s:,.0f} N s/m",
        f"  the body on the secondary springs at {vehicle.secondary_frequency_hz:.2g} Hz, "
        f"the bogie on the primary ones at {vehicle.primary_frequency_hz:.2g} Hz",
    ]


def _read(words: Sequence[str], form: Sequence[Entry]) -> dict[str, Any]:
    """Return the values of KEY=VALUE; ValueError if a key is unknown or a value no number."""
    names = [entry.name for entry in form]
    values: dict[str, Any] = {}
    for word in words:
        key, _, text = word.partition("=")
        if key not in names:
            raise ValueError(f"`{key}` is not known; allowed are {', '.join(names)}")
        if key == "source":
            values[key] = text
            continue
        try:
            values[key] = None if text == "null" else float(text)
        except ValueError:
            raise ValueError(f"`{key}` must be a number, got {text!r}") from None
    return values


def _text(
    name: str, form: Sequence[Entry], values: Mapping[str, Any], guessed: dict[str, float]
) -> str:
    lines = [f"# {name}: all numbers are SI and of one bogie side", f"name: {_scalar(name)}"]
    for entry in form:
        key = entry.name
        if key in values or key in guessed:
            sentence = re.sub(r"; .*", "", entry.setting.setting.sentence)
            lines.append(f"# {sentence} [{entry.setting.rule}]")
            lines.append(f"# {FROM[key]}" + f"; {entry.exactness}" * bool(entry.exactness))
            how = f"  # assumed, as a share of {GUESSED[key][0]}" if key in guessed else ""
            lines.append(f"{key}: {_scalar(guessed.get(key, values.get(key)))}{how}")
    return "\n".join(lines) + "\n"


def _scalar(value: object) -> str:
    """Return a value in YAML on one line."""
    return str(yaml.safe_dump(value, allow_unicode=True, width=10**6)).partition("\n")[0]
