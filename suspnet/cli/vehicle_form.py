"""The file of a vehicle to be filled in: each number with what it is and where it is found."""

import os
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from string import Template

from suspnet.ground.storage import printable, write_atomically
from suspnet.ground.wording import command

NAME = re.compile(r"[A-Za-z_][\w.-]{0,99}", re.ASCII)
FORM = Template(resources.files("suspnet.cli").joinpath("vehicle_form.yaml").read_text("utf-8"))
"""The file of a vehicle ``$name``; ``???``, as Hydra marks it, is what the user has to give."""


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
    write_atomically(path, FORM.substitute(name=name), force=force)
    option = "--config-dir", path.parents[1]
    print(
        printable(
            f"-> {path}: fill in each ???\nuse it: {command('check', 'DIR', *option)}\n"
            f"        {command('train', *option, f'vehicle={name}')} ..."
        )
    )
    return 0
