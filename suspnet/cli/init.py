"""Write a template of a manifest from data files: suspnet-init FILE ..."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace, RawDescriptionHelpFormatter
from functools import partial
from pathlib import Path

from suspnet.cli import program
from suspnet.ground.storage import write_atomically
from suspnet.ground.wording import count
from suspnet.recordings.formats import READERS
from suspnet.recordings.manifest_keys import TripError, all_of
from suspnet.trips.file_contents import look_into
from suspnet.trips.manifest_template import template

DESCRIPTION = """\
Write a manifest of one trip from its data files: their columns, with the rates and units that the
files say. Which column is which channel is guessed from names (axle box, bogie frame, body, left,
right, speed; in English or German) and marked as a guess; where names do not tell, the columns
stand there as comments to choose from. What is not known is marked FILL_IN."""

EPILOG = """\
  suspnet-init trip_7/*.csv -o trip_7.yaml      then fill in what is marked, and
  suspnet-check trip_7.yaml"""


def parser() -> ArgumentParser:
    """Return what the command line may hold."""
    found = ArgumentParser(
        "suspnet-init",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=RawDescriptionHelpFormatter,
    )
    found.add_argument(
        "files",
        nargs="+",
        type=Path,
        metavar="FILE",
        help=f"data file of one trip [one or more paths with {', '.join(sorted(READERS))}]",
    )
    found.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="the manifest that is written [path that ends with .yaml; FIRST.yaml beside the first "
        "data file if not given]",
    )
    found.add_argument(
        "--force", action="store_true", help="replace the manifest if there is one [switch]"
    )
    return found


def init(arguments: Namespace) -> None:
    """Write a manifest from what the command line names and tell what is left to do.

    Raises
    ------
    ValueError
        If a file cannot be read; the message tells of all of them.
    FileExistsError
        If there is such a manifest and it is not to be replaced.
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


def main() -> None:
    """Run the program."""
    arguments = parser().parse_args()
    program.run(lambda: init(arguments))
