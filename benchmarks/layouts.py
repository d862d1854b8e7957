"""What each layout of sensors shows of a bogie's parts, before sensors are bought.

python benchmarks/layouts.py [vehicle=am96 speed_m_per_s=70 data.minutes=20 ...]

Overrides are those of train.py with data=trips. Largest Cramer-Rao bound of each kind of part over
twelve trips, on each of which one part is at 80 %: one standard deviation in % of the part. The
spectra of mean, cross level and alignment of the track are unknown in every bin. Vehicle known:
only its parts and its car-body mass are unknown; learnt: all its numbers are, and healthy trips
came before. Three sensors do not determine the response to three inputs of unknown spectra: they
take the mean of both rails as incoherent with what differs between these. Writes layouts.csv.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cells import Parser, Row, at_least
from hydra import compose, initialize_config_dir
from tabulate import tabulate

from suspnet import LayoutBounds, SpatialVehicle, layout_bounds
from suspnet.cli import program  # noqa: F401 - makes our resolvers known to Hydra
from suspnet.cli.kinds import build
from suspnet.ground.parameters import BODY_MASS, COMPONENTS, PARAMETERS, kind_of
from suspnet.ground.storage import write_atomically
from suspnet.runs.tables import records_csv
from suspnet.trains.identification.bogie_trips import PARTS_OF_BOGIE
from suspnet.trains.identification.layouts import LAYOUTS

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
KNOWN, LEARNT = "vehicle known", "vehicle learnt"


def layouts_markdown(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a row for each layout: the largest bound of each kind of part, for each case."""
    header = ["sensors", *(f"{case}: {', '.join(PARAMETERS[:4])}" for case in _cases(records))]
    rows = [[name, *map(_cell, by_case.values())] for name, by_case in _largest(records).items()]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def _records(found: LayoutBounds, share: float) -> list[Row]:
    """Return a record for each case and part of a layout."""
    alone = f", each wheelset excited alone at {100 * share:g} %" if share else ""
    return [
        {
            "layout": found.layout,
            "case": f"{case}{alone}",
            "parameter": name,
            "bound_percent": float(bound),
            "sensors": " ".join(found.sensors),
        }
        for case, bounds in ((KNOWN, found.known), (LEARNT, found.learnt))
        for name, bound in zip(COMPONENTS, bounds, strict=True)
    ]


def _cases(records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the cases that are shown: of wheelsets excited alone, only that of learnt vehicles."""
    cases = dict.fromkeys(record["case"] for record in records)
    return [case for case in cases if case == KNOWN or case.startswith(LEARNT)]


def _largest(records: Sequence[Mapping[str, Any]]) -> dict[str, dict[str, dict[str, float]]]:
    """Return the largest bound of each kind of part, by layout and case."""
    found: dict[str, dict[str, dict[str, float]]] = {}
    for case in _cases(records):
        for record in (one for one in records if one["case"] == case):
            kind = kind_of(record["parameter"])
            kinds = found.setdefault(record["layout"], {}).setdefault(case, {})
            kinds[kind] = max(kinds.get(kind, 0.0), record["bound_percent"])
    return found


def _cell(kinds: Mapping[str, float]) -> str:
    return ", ".join(f"{bound:.2g}" for kind, bound in kinds.items() if kind != BODY_MASS)


def main() -> None:
    parser = Parser(description=__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("--n-healthy", type=at_least(1), default=5)
    parser.add_argument("--wheelset-share", type=at_least(0, float), default=0.01)
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder of the CSV")
    options = parser.parse_args()
    with initialize_config_dir(str(ROOT / "configs"), version_base="1.3"):
        config = compose("train", ["data=trips", *options.overrides])
    vehicle, settings = build(config, "vehicle"), build(config, "data")
    generator = SpatialVehicle(vehicle, speed_m_per_s=settings.speed_m_per_s, parts=PARTS_OF_BOGIE)
    rows = [
        row
        for share in sorted({0.0, options.wheelset_share})
        for bounds in layout_bounds(generator, LAYOUTS, settings, options.n_healthy, share)
        for row in _records(bounds, share)
    ]
    write_atomically(options.output / "layouts.csv", records_csv(rows))
    print(layouts_markdown(rows))


if __name__ == "__main__":
    main()
