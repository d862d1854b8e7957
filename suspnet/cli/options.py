"""Options of the programs without a configuration: suspnet check, demo, init and history.

They are parsed before the programs' modules are imported.
"""

from argparse import ArgumentParser, RawDescriptionHelpFormatter
from collections.abc import Callable, Mapping
from pathlib import Path

from suspnet.ground.parameters import PARAMETERS, Cause
from suspnet.ground.records import EVENT_KINDS, PLACE_FROM_TRAIN

CHECK_DESCRIPTION = """\
Read manifests and recordings, with a model or without. Show all problems at once, and what an
estimate could use: usable share, steady speeds, independent averages, coherence in the vehicle's
band, pairs of sensors; for a known vehicle also whether units, signs and the order of the channels
are plausible. A trip is ready if a model of its speed would read it; with --run if the models of
that run do.

The output folder gets check.html, check.json and a picture of each trip that could be read: its
channels and speed, their spectra, and the coherence. Trips are not changed."""
CHECK_EPILOG = """\
exit code: 0 if every trip could be read, 1 if there is any problem.

  suspnet check trips/car7 --run outputs/trips/RUN       are these trips read by that model?"""
DEMO_DESCRIPTION = """\
Simulate a train of which one damper fades, learn it on its first trips and read all of them. Print
the verdict, and open the report in a browser if there is one. Trips, model and report are in the
folder demo, which must be new or from an earlier call."""
INIT_DESCRIPTION = """\
Write the manifests of all trips of a folder, or of one trip, from data files: their columns, with
the rates and units that the files state. Which column is which channel is guessed from names (axle
box, bogie frame, body, left, right, speed; in English or German) and marked as a guess. If anything
is missing, it is listed and nothing is written. With --vehicle, write the file of a vehicle."""
INIT_EPILOG = """\
  suspnet init trips/car7 vehicle=am96 suspension="car 7" --table km.csv
  suspnet init --vehicle mine vehicles          the file of a vehicle, to be filled in
  suspnet init trip_7/*.csv -o trip_7.yaml      the manifest of one trip"""
HISTORY_DESCRIPTION = """\
The history of a fleet, as written by evaluate.py trips=DIR store=STORE: list it, add maintenance,
show and acknowledge alarms, export all of it as tables."""
HISTORY_EPILOG = """\
  suspnet history fleet.db event --vehicle am96 --suspension "car 7, left" --at-km 120000 \\
      --kind exchanged --words "new primary dampers"
  suspnet history fleet.db acknowledge --vehicle am96 --suspension "car 7, left" \\
      --parameter k_p --by "Kim Li" --words "spring ordered"
  suspnet history fleet.db notify notify.yaml --follow

STORE is a file, or postgresql://user:password@host/database."""


def _parser(name: str, description: str, epilog: str) -> ArgumentParser:
    return ArgumentParser(
        name, description=description, epilog=epilog, formatter_class=RawDescriptionHelpFormatter
    )


def check_parser() -> ArgumentParser:
    """Return the options of suspnet check."""
    parser = _parser("suspnet check", CHECK_DESCRIPTION, CHECK_EPILOG)
    add = parser.add_argument
    trips = "folder of manifests (*.yaml), or of such folders; or a manifest [one or more paths]"
    add("trips", nargs="+", type=Path, metavar="DIR", help=trips)
    output = "folder of the results, new or of an earlier check [path; outputs/check/TIME]"
    add("-o", "--output", type=Path, metavar="DIR", help=output)
    language = "language of page and pictures; check.json and the terminal are English [en]"
    add("--language", default="en", choices=("en", "de"), help=language)
    pictures = "draw nothing, which is faster [switch]"
    add("--no-pictures", action="store_true", help=pictures)
    workers = "number of processes that read trips [whole number; at least 1; 1 up to 10 trips]"
    add("--workers", type=int, metavar="N", help=workers)
    description = "folder with your own vehicles, vehicle/NAME.yaml, as for train.py [path; none]"
    add("--config-dir", type=Path, metavar="DIR", help=description)
    run = "training whose models must read the trips; may be given several times [path; none]"
    add("--run", type=Path, action="append", metavar="DIR", help=run)
    return parser


def init_parser() -> ArgumentParser:
    """Return the options of suspnet init."""
    from suspnet.trains.recordings.formats import READERS  # with pyarrow

    parser = _parser("suspnet init", INIT_DESCRIPTION, INIT_EPILOG)
    add = parser.add_argument
    files = (
        "folder of data files of any number of trips, or data files of one trip, and what holds "
        "for all of them as KEY=VALUE; of --vehicle the folder of vehicles "
        f"[paths with {', '.join(sorted(READERS))}]"
    )
    add("files", nargs="*", metavar="DIR | FILE | KEY=VALUE", help=files)
    description = (
        "folder with your own vehicles, vehicle/NAME.yaml: the trips' vehicle must be one of them "
        "or of suspnet's [path; none]"
    )
    add("--config-dir", type=Path, metavar="DIR", help=description)
    table = (
        "table of the trips with columns file, mileage_km, start, direction and "
        "other keys of a manifest, names in English or German; if there is no such file and "
        "mileages are missing, it is written to be filled in [path of a CSV file]"
    )
    add("--table", type=Path, metavar="FILE", help=table)
    vehicle = (
        "write DIR/vehicle/NAME.yaml, in which you fill in the numbers [name; DIR is vehicles]"
    )
    add("--vehicle", metavar="NAME", help=vehicle)
    output = "the manifest of one trip [path that ends with .yaml; next to the first data file]"
    add("-o", "--output", type=Path, metavar="FILE", help=output)
    add("--force", action="store_true", help="replace the manifest if there is one [switch]")
    return parser


def history_parser() -> ArgumentParser:
    """Return the options of suspnet history."""
    parser = _parser("suspnet history", HISTORY_DESCRIPTION, HISTORY_EPILOG)
    parser.add_argument("store", metavar="STORE", help="the store [path or URL]")
    does = parser.add_subparsers(
        dest="does", required=True, metavar="list | event | alarms | acknowledge | export | notify"
    )
    does.add_parser("list", help="each suspension with its trips and maintenance")
    # what people tell the store: maintenance that was done, and alarms that they have seen
    event = does.add_parser(
        "event", help="add maintenance: severities and tests for changes use later trips only"
    )
    _add_suspension(event)
    event.add_argument(
        "--at-km", type=float, required=True, metavar="KM", help="mileage at which it was done [km]"
    )
    event.add_argument("--kind", choices=EVENT_KINDS, default="other", help="[other if not given]")
    event.add_argument(
        "--words",
        default="",
        help="what was done; of --kind sensor the sensor's name, as body left [text]",
    )
    alarms = does.add_parser(
        "alarms", help="open alarms, the worst first, and who acknowledged them"
    )
    alarms.add_argument("--all", action="store_true", help="also closed alarms")
    seen = does.add_parser("acknowledge", help="acknowledge the open alarms of a parameter")
    _add_suspension(seen)
    seen.add_argument(
        "--parameter",
        required=True,
        metavar="NAME",
        help=f"parameter of the alarms, {', '.join(PARAMETERS)}, a part, as c_p_axle1_left, or a "
        "sensor, as body left [text]",
    )
    seen.add_argument("--cause", choices=tuple(Cause), help="[all causes if not given]")
    seen.add_argument("--by", required=True, metavar="NAME", help="who acknowledges them [text]")
    seen.add_argument("--words", default="", help="what is done about it [text]")
    export = does.add_parser("export", help="write all of it as Parquet and CSV")
    export.add_argument(
        "folder", type=Path, metavar="DIR", help="a new folder, or that of an earlier export [path]"
    )
    notify = does.add_parser("notify", help="send new alarms and digests to people and systems")
    notify.add_argument(
        "rules", type=Path, metavar="FILE", help="recipients and channels [path of a YAML file]"
    )
    notify.add_argument(
        "--follow", action="store_true", help="go on until Ctrl-C instead of once [switch]"
    )
    notify.add_argument(
        "--retry", action="store_true", help="first make messages due that were given up [switch]"
    )
    return parser


def _add_suspension(command: ArgumentParser) -> None:
    command.add_argument("--vehicle", required=True, help="as in the manifests [text]")
    for name in PLACE_FROM_TRAIN:
        command.add_argument(
            f"--{name}", default="", help="as in the manifests, if given there [text]"
        )


PARSERS: Mapping[str, Callable[[], ArgumentParser]] = {
    "check": check_parser,
    "demo": lambda: _parser("suspnet demo", DEMO_DESCRIPTION, ""),
    "init": init_parser,
    "history": history_parser,
}
"""Parser of each program's command line."""
