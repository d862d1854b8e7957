"""The command ``suspnet``: one name for all programs.

Nothing is imported here that takes time: a program is imported when it is started.
"""

import sys
from difflib import get_close_matches

from suspnet._version import __version__
from suspnet.cli.signals import output_ended
from suspnet.cli.start import PROGRAMS, start

MEANINGS = {
    "demo": "see it work: simulate a train, learn it, read it",
    "init": "write manifests of a folder of data files, or the file of a vehicle",
    "check": "show what is wrong with recordings, before a model or with one",
    "train": "commission a suspension on healthy trips; train and score a method",
    "evaluate": "read trips with trained models; score models; run a study; plan a fleet",
    "history": "list a store of trips, add maintenance, acknowledge alarms, write tables",
    "monitor": "read frames of running trains as they come",
    "replay": "send recorded trips as such frames",
    "serve": "show the fleet in a browser",
    "simulate": "write an example fleet with known parameters",
}
"""What each program does, in the order in which they are needed."""
HELP = f"""\
Usage: suspnet PROGRAM ...

Stiffness and damping of train suspensions from three vertical accelerometers.

{chr(10).join(f"  {name:12}{meaning}" for name, meaning in MEANINGS.items())}

  suspnet PROGRAM --help    options and settings of a program
  suspnet --version

  suspnet demo
  suspnet init trips/car7 vehicle=am96 suspension="car 7"
  suspnet check trips/car7
  suspnet train healthy=trips/car7 n_healthy=5
  suspnet evaluate trips=trips/car7 run=outputs/trips/RUN"""


def main() -> None:
    """Run the program that the command line names."""
    first, *arguments = sys.argv[1:] or ["--help"]
    if first in MEANINGS:
        sys.argv = [f"{sys.argv[0]}-{first}", *arguments]
        start(first)
    elif first in ("-h", "--help", "help"):
        _print(HELP)
    elif first in ("-V", "--version"):
        _print(f"suspnet {__version__}")
    else:
        near = get_close_matches(first, PROGRAMS, n=1)
        meant = f"did you mean {near[0]}? " if near else ""
        sys.exit(f"error: there is no program {first!r}: {meant}suspnet --help lists them")


def _print(text: str) -> None:
    """Print to standard output; a reader that ends early, such as head, is no mistake."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        sys.exit(output_ended())
