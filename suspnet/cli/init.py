"""Write a template of a manifest from data files: suspnet-init FILE ..."""

from __future__ import annotations

from argparse import Namespace
from functools import partial

from suspnet.ground.storage import write_atomically
from suspnet.ground.wording import count
from suspnet.recordings.errors import TripError, all_of
from suspnet.trips.file_contents import look_into
from suspnet.trips.manifest_template import template


def init(arguments: Namespace) -> None:
    """Write a manifest from data files and print what must still be filled in.

    ValueError if files cannot be read (the message lists all of them), or if the manifest exists
    and is not to be replaced.
    """
    files = list(dict.fromkeys(arguments.files))
    path = arguments.output or files[0].with_suffix(".yaml")
    if path.suffix != ".yaml":
        raise ValueError(f"the name of a manifest must end with .yaml, got {path}")
    if path.exists() and not arguments.force:
        raise ValueError(f"{path} exists; --force replaces it, --output writes another")
    try:
        seen = all_of(partial(look_into, file) for file in files)
    except TripError as error:
        raise ValueError("; ".join(error.problems)) from error
    signals = [one for found, _ in seen for one in found]
    found = template(signals, path, [how for _, how in seen if how])
    write_atomically(path, found.text, force=arguments.force)
    print(
        f"-> {path}: {count(len(signals), 'column')} of {count(len(files), 'file')}\n"
        f"fill in: {', '.join(found.blanks)}\n"
        f"guessed, to be checked: {', '.join(found.guesses) or 'nothing'}\n"
        f"then run: suspnet-check {path}"
    )
