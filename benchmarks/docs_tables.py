"""Write the tables of README and docs from the results that the scripts here left, and the comments
of configs/ from the sentences that settings are declared with.

python benchmarks/docs_tables.py

A table stands between the lines <!-- table NAME --> and <!-- end --> of a page. One whose results
are missing stays as it is, and is named.
"""

import csv
import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import config_comments
import fair
import interval_coverage
import methods_table
import named_parts
import numpy as np
import readings
import rough_train
from against_n import METHODS, TUBE
from cells import Parser, Row
from layouts import layouts_markdown
from paper_exhibits import impact_rows
from tabulate import tabulate
from tube import tube_markdown

from suspnet.cli.kinds import read_vehicles
from suspnet.ground.storage import write_atomically
from suspnet.runs.tables import MODEL_TITLES, table6_caption, table6_markdown
from suspnet.trains.fits.bogie_fit import FURTHER_PARTS
from suspnet.vehicle import QuarterCar
from suspnet.vehicle.quantities import PARTS, PLACES, QUANTITIES, SPATIAL_QUANTITIES

ROOT = Path(__file__).parents[1]
RESULTS = Path(__file__).parent / "results"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"(<!-- table (\w+) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def markdown(rows: Sequence[Sequence[str]], header: Sequence[str]) -> str:
    """Return a table as Markdown, each number as it is written."""
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def table6_rows(rows: Sequence[Row], protocol: str) -> list[Row]:
    """Return the MAPE rows of Table VI of one protocol; ValueError if there are none."""
    found = [r for r in rows if (r["protocol"], r["metric"]) == (protocol, "mape_percent")]
    if not found:
        raise ValueError(f"no rows of protocol {protocol}")
    return found


def table6(rows: Sequence[Row], protocol: str = "multi_location") -> str:
    """Return Table VI, published beside measured, with its settings but no times."""
    chosen = table6_rows(rows, protocol)
    settings = table6_caption(chosen).partition("; time taken")[0]
    return f"{table6_markdown(chosen)}\n\n{settings}"


def table6_paper(rows: Sequence[Row]) -> str:
    """Return Table VI in the paper's own set-up."""
    return table6(rows, "paper")


def table6_short(rows: Sequence[Row]) -> str:
    """Return the paper's Table VI next to what was measured, and the bound."""
    chosen = table6_rows(rows, "paper")
    models = [name for name in MODEL_TITLES if any(r["model"] == name for r in chosen)]
    lines = []
    for output in dict.fromkeys(r["output"] for r in chosen):
        by_model = {r["model"]: r for r in chosen if r["output"] == output}
        published = [by_model[name].get("published") for name in models]
        pairs = [
            f"{by_model[name]['measured']:#.3g}" + (f" ({paper:g})" if paper else "")
            for name, paper in zip(models, published, strict=True)
        ]
        lines.append([output, *pairs, f"{by_model['msvr']['bound']:#.3g}"])
    titles = [MODEL_TITLES[name] for name in models]
    return markdown(lines, ["MAPE %, ours (the paper's)", *titles, "bound"])


def readings_table(rows: Sequence[Row]) -> str:
    """Return the readings of the paper by their distance to its Table VI, on all test curves."""
    records = [
        {
            **row,
            "rmse_over_mape": [row["rmse_over_mape_low"], row["rmse_over_mape_high"]],
            "mape_percent": {
                output: [row[f"{output}_{method}"] for method in readings.METHODS]
                for output in readings.OUTPUTS
            },
        }
        for row in rows
        if row["test"] == "all"
    ]
    return readings.readings_markdown(records)


def fair_rows(rows: Sequence[Row]) -> list[Row]:
    """Return the records of methods tuned alike, with None where the file has nothing."""
    keys = dict.fromkeys(key for row in rows for key in row)
    return [{**dict.fromkeys(keys), **row} for row in rows]


def whole_grid(rows: Sequence[Row]) -> str:
    """Return the MAPE of MSVR for each number of training curves and choice of test vehicles."""
    titles = {"sobol": "between the grid's points", "grid": "on the grid"}
    lines = [
        [
            str(row["data.n_train"]),
            f"{row['n_components']:,}",
            f"{row['C']:,}",
            titles[str(row["protocol.test_sampling"])],
            *(f"{row[output]:#.3g}" for output in readings.OUTPUTS),
        ]
        for row in rows
    ]
    return markdown(lines, ["training curves", "features", "C", "test vehicles", *readings.OUTPUTS])


def paper(rows: Sequence[Row]) -> str:
    """Return each exhibit of the paper, next to what paper_exhibits.py made of it."""
    lines = []
    for row in rows:
        home = f"[{Path(str(row['home'])).name}](../{row['home']})"
        command = f"`{row['command']}`" if "command" in row else ""
        lines.append([str(row[key]) for key in ("item", "paper", "ours")] + [home, command])
    return markdown(lines, ["item", "the paper", "here", "implemented in", "made alone by"])


def paper_impact(_: Sequence[Row]) -> str:
    """Return the impact of each parameter on the largest peaks of the AM96 (Fig. 7)."""
    rows = impact_rows(QuarterCar(read_vehicles()["am96"]))
    return markdown([list(row.values()) for row in rows], list(rows[0]))


OTHERS = PLACES[1:]
ORDER = ("", *PARTS, *FURTHER_PARTS)


def family(_: Sequence[Row]) -> str:
    """Return the numbers of the family of vehicles that commissioning fits, with their priors."""
    lines = []
    # numbers of each sensor stand once, for the first place
    added = [
        q for q in SPATIAL_QUANTITIES if q.part in FURTHER_PARTS and not q.name.endswith(OTHERS)
    ]
    for one in sorted([*QUANTITIES, *added], key=lambda one: ORDER.index(one.part)):
        if one.deviation:
            nominal = "given" if one.nominal is None else f"{one.nominal:g} {one.unit}".strip()
            part = one.part or "all"
            deviation = f"{one.deviation:g}" + " of 1 + ratio" * one.may_be_absent
            name, meaning = (text.replace(PLACES[0], "PLACE") for text in (one.name, one.meaning))
            lines.append([part, f"`{name}`", meaning, nominal, deviation])
    for line, above in reversed(list(itertools.pairwise(lines))):
        if line[0] == above[0]:
            above[0] = ""
    return markdown(lines, ["part", "name", "meaning", "nominal", "deviation"])


def against_n(rows: Sequence[Row]) -> str:
    """Return time, memory and error of each method at a few numbers of samples, for each tube."""
    sizes = [n for n in (2000, 22_801, 364_816) if any(r["n"] == n for r in rows)]
    done = {(r["method"], r["epsilon"], r["n"]): r for r in rows if "rmse" in r}
    lines = []
    for name, epsilon in dict.fromkeys((r["method"], r["epsilon"]) for r in rows):
        line = [METHODS[name].title, f"{epsilon:g}" if METHODS[name].has_tube else "none"]
        for n in sizes:
            row = done.get((name, epsilon, n), {})
            for key, form in (("seconds", ".2g"), ("rmse", ".2g"), ("peak_mib", ".0f")):
                line.append(format(row[key], form) if key in row else "-")
        lines.append(line)
    lines.sort(key=lambda line: line[1] == f"{TUBE:g}")
    headers = [f"{what}{n:,}" for n in sizes for what in ("s, n = ", "error, ", "MiB, ")]
    return markdown(lines, ["method", "tube", *headers])


def plan(rows: Sequence[Row]) -> str:
    """Return what a plan costs beside other policies, for each price of a part and a failure."""
    header = ["R", "F", "plan", "fixed, L10", "fixed, best", "to the limit", "lives known", "bound"]
    keys = ["plan", "customary", "best fixed", "to limit", "known lives", "bound"]
    lines = [
        [f"{r['R']:g}", f"{r['F']:g}", *(f"{r[key]:.3g}" for key in keys)]
        for r in rows
        if r["R"] != 2 or r["F"] in (0, 1, 10, 100)
    ]
    return markdown(lines, header)


def life(rows: Sequence[Row]) -> str:
    """Return how often the 80 % intervals of the remaining life hold, and how wide they are."""
    header = ["wear", "n", "share of life", "80 % intervals hold", "width"]
    lines = [
        [
            r["histories"] + (f": {r['kind']}" if r["kind"] != "all" else ""),
            r["n"],
            f"{r['share_of_life']:g}",
            f"{r['coverage_percent']:.0f} % ({r['least_percent']:.0f} to {r['most_percent']:.0f})",
            f"{r['median_width']:.2g}",
        ]
        for r in rows
        if r["kind"] in ("all", "bent")
    ]
    return markdown(lines, header)


def alarms(rows: Sequence[Row]) -> str:
    """Return false alarms of healthy histories of each kind."""
    lines = [[r["healthy"], r["n"], r["alarms"], f"{r['per 1e6 km']:.3g}", r["95 %"]] for r in rows]
    return markdown(lines, ["healthy histories", "n", "alarms", "in 1,000,000 km", "95 %"])


def alarms_delays(rows: Sequence[Row]) -> str:
    """Return the delays of each change of k_p and c_p."""
    lines = [
        [r["change"], r["of"], *r["suspnet"].split(" / ")]
        for r in rows
        if r["of"] in ("k_p", "c_p")
    ]
    header = ["change", "of", "median, trips", "90 % quantile, trips", "within 50 trips"]
    return markdown(lines, header)


SHOWN_VIEWS = (
    "until something is shown",
    "first view of all",
    "cold start, page of the fleet",
    "first view of a served store",
    "page of the fleet",
    "page of a suspension",
    "view after one new trip",
    "view after a new trip of each",
)
"""Rows of benchmarks/page.py that the docs show, those of pages as the server sends them."""


def page(rows: Sequence[Row]) -> str:
    """Return times of the fleet page and of the state behind it."""
    cells = [
        [
            f"{r['what']}, by {r['by']}" if r.get("by") in ("HTTP", "client") else str(r["what"]),
            f"{r['median_s']:.3g}" if r["n"] > 1 else "",
            f"{r['worst_s']:.3g}" if r["worst_s"] else "",
            f"{r['processor_s']:.3g}" if r["processor_s"] else "",
            f"{r['peak_mib']:.0f}",
        ]
        for r in rows
        if r["what"] in SHOWN_VIEWS and r.get("by") != "client"
    ]
    header = ["", "median, s", "worst, or once, s", "processor, s", "largest memory so far, MiB"]
    return markdown(cells, header)


BLIND = ("all at once",)
"""The hardest case of benchmarks/named_parts.py, which the docs show."""
LAYOUT_CASES = tuple(f"all at once, {name}" for name in named_parts.LAYOUTS)
"""Those with other layouts of sensors."""


def one_side(rows: Sequence[Row]) -> str:
    """Return what each reading of worn trips says of the damper that fades, in % of healthy."""
    lines: dict[str, list[str]] = {}
    for row in rows:
        if row["truth"] < 1:
            line = lines.setdefault(row["trip"], [f"{100 * row['truth']:.1f}"])
            low, high = (f"{100 * row[end]:.3g}" for end in ("low", "high"))
            value = f"{100 * row['estimate']:.3g} ({low} to {high})"
            line.append("no estimate" if np.isnan(row["estimate"]) else value)
    heads = ["c_p of axle 2, left", "six sensors", "three on the left", "three on the right"]
    return markdown(list(lines.values()), heads)


def training_time(rows: Sequence[Row]) -> str:
    """Return the seconds of each training."""
    lines = [[*(str(v) for v in row.values())] for row in rows]
    return markdown(lines, list(rows[0]))


TABLES: dict[str, tuple[str | None, Callable[[Sequence[Row]], str]]] = {
    "table6": ("table6.csv", table6),
    "table6_short": ("table6.csv", table6_short),
    "table6_paper": ("table6.csv", table6_paper),
    "readings": ("readings.csv", readings_table),
    "fair": ("fair.csv", lambda rows: fair.errors_markdown(fair_rows(rows))),
    "fair_differences": ("fair.csv", lambda rows: fair.differences_markdown(fair_rows(rows))),
    "whole_grid": ("whole_grid.csv", whole_grid),
    "tube": ("tube.csv", tube_markdown),
    "paper": ("paper.csv", paper),
    "paper_impact": (None, paper_impact),
    "coverage": ("coverage.csv", interval_coverage.table),
    "family": (None, family),
    "against_n": ("against_n.csv", against_n),
    "plan": ("plan.csv", plan),
    "alarms": ("alarms.csv", alarms),
    "alarms_delays": ("alarms_delays.csv", alarms_delays),
    "life": ("remaining_life.csv", life),
    "page": ("page.csv", page),
    "named_parts": (None, lambda rows: named_parts.named_table(named_parts.stored(BLIND))),
    "named_parts_errors": (
        None,
        lambda rows: named_parts.accuracy_table(named_parts.stored(BLIND), pooled=True),
    ),
    "layouts_read": (
        None,
        lambda rows: named_parts.layouts_table(named_parts.stored(LAYOUT_CASES)),
    ),
    "rough_train": ("rough_train.csv", rough_train.table),
    "training_time": ("training_time.csv", training_time),
    "one_side": ("one_side.csv", one_side),
    "methods": ("methods.csv", methods_table.table),
    "layouts": (
        "layouts.csv",
        lambda rows: layouts_markdown([r for r in rows if r["case"] != "vehicle known"]),
    ),
}
"""Results, None where the package itself says it, and what makes a table of them, by name."""


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a CSV, numbers as numbers; what is empty is left out."""
    with open(path, newline="") as file:
        return [
            {key: number(text) for key, text in row.items() if text} for row in csv.DictReader(file)
        ]


def number(text: str) -> float | int | str:
    """Return a text as a number if it is one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def filled(page: str) -> tuple[str, list[str]]:
    """Return a page with its tables written anew, and the names of those that could not be."""
    missing = []

    def write(block: re.Match[str]) -> str:
        begin, name, _, end = block.groups()
        file, make = TABLES[name]
        try:
            return f"{begin}{make(read_rows(RESULTS / file) if file else ())}\n{end}"
        except (FileNotFoundError, ValueError):
            missing.append(name)
            return block.group()

    return BLOCK.sub(write, page), missing


def main() -> None:
    Parser(description=__doc__.splitlines()[0]).parse_args()
    for path in sorted((ROOT / "configs").rglob("*.yaml")):
        write(path, config_comments.commented(path))
    config_comments.read_comments.cache_clear()
    for path in PAGES:
        new, missing = filled(path.read_text(encoding="utf-8"))
        write(path, new, f"; no results for {', '.join(missing)}" if missing else "")


def write(path: Path, new: str, left: str = "") -> None:
    """Write a file whose text is another one now, and report it."""
    is_new = new != path.read_text(encoding="utf-8")
    if is_new:
        write_atomically(path, new)
    if is_new or path in PAGES:
        print(f"{path.relative_to(ROOT)}: {'written' if is_new else 'unchanged'}{left}")


if __name__ == "__main__":
    main()
