"""The study of sensor layouts: what each shows of a bogie's parts, before sensors are bought."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from tabulate import tabulate

from suspnet.dynamics import SpatialVehicle, Vehicle
from suspnet.dynamics.vehicle import GEOMETRY
from suspnet.estimation.bogie_trips import HIGH_HZ, LOW_HZ, PARTS_OF_BOGIE
from suspnet.estimation.layouts import LAYOUTS, WORN, LayoutBounds, layout_bounds
from suspnet.ground.parameters import BODY_MASS, COMPONENTS, PARAMETERS, kind_of
from suspnet.ground.settings import check_number
from suspnet.report.figures import SYMBOLS
from suspnet.runs.tables import Record, write_study
from suspnet.spectra.estimates import EstimateSettings
from suspnet.spectra.observation import Observation

log = logging.getLogger(__name__)
KNOWN, LEARNT = "vehicle known", "vehicle learnt"


def write_layouts(
    vehicle: Vehicle, settings: Observation, folder: Path, *, n_healthy: int, wheelset_share: float
) -> list[Record]:
    """Write layouts.md, .csv, .json and .png; print the table; return the records.

    `n_healthy`: number of healthy trips that the vehicle is learnt from; `wheelset_share`: density
    of what excites each wheelset alone over the mean track's, 0 leaves this case out.
    """
    check_number("wheelset_share", wheelset_share, low=0, most=1)
    if not isinstance(settings, EstimateSettings):
        raise ValueError("sensor layouts are compared on recordings of trips: take data=trips")
    missing = [name for name in GEOMETRY if getattr(vehicle, name) is None]
    if missing:
        raise ValueError(
            f"vehicle {vehicle.name!r} lacks {missing}: without them, no layout can distinguish "
            "its parts; give them in its file"
        )
    generator = SpatialVehicle(vehicle, speed_m_per_s=settings.speed_m_per_s, parts=PARTS_OF_BOGIE)
    records = []
    for share in [0.0, wheelset_share] if wheelset_share else [0.0]:
        for one in layout_bounds(generator, LAYOUTS, settings, n_healthy, share):
            records += _records(one, share)
    title = f"Sensor layouts: {vehicle.name}"
    text = f"# {title}\n\n{_setting(settings, n_healthy)}\n\n{layouts_markdown(records)}\n"
    content = {
        "vehicle": vehicle.name,
        "settings": asdict(settings),
        "n_healthy": n_healthy,
        "wheelset_share": wheelset_share,
        "bounds": records,
    }
    write_study(folder, "layouts", text, content, records, {"layouts": layouts_figure(records)})
    log.info("%s\n-> %s/layouts.*", text, folder)
    return records


def layouts_markdown(records: Sequence[Mapping[str, Any]]) -> str:
    """Return a row for each layout: the largest bound of each kind of part, for each case."""
    header = ["sensors", *(f"{case}: {', '.join(PARAMETERS[:4])}" for case in _cases(records))]
    rows = [[name, *map(_cell, by_case.values())] for name, by_case in _largest(records).items()]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def layouts_figure(records: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw the largest bound of each kind of part of each layout, an axis for each case."""
    largest, cases = _largest(records), _cases(records)
    figure = Figure(
        figsize=(3.2 + 3.2 * len(cases), 1.4 + 0.34 * len(largest)), layout="constrained"
    )
    axes = figure.subplots(1, len(cases), squeeze=False, sharey=True)[0]
    for axis, case in zip(axes, cases, strict=True):
        for name in PARAMETERS[:4]:
            bounds = [by_case[case][name] for by_case in largest.values()]
            axis.plot(bounds, range(len(bounds)), "o", label=SYMBOLS[name])
        axis.set(xscale="log", title=case.replace(", ", ",\n"), xlabel="largest bound [%]")
        axis.grid(axis="y", alpha=0.3)
        axis.xaxis.set_major_formatter("{x:g}")
    axes[0].set_yticks(range(len(largest)), list(largest))
    axes[0].invert_yaxis()
    axes[-1].legend(fontsize="small")
    return figure


def _records(found: LayoutBounds, share: float) -> list[Record]:
    """Return a record for each case and part of a layout."""
    alone = f", each wheelset excited alone at {100 * share:g} %" if share else ""
    title = f"{found.layout}, inputs independent" if found.are_independent else found.layout
    return [
        {
            "layout": title,
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


def _setting(settings: EstimateSettings, n_healthy: int) -> str:
    low, high = (
        default if end is None else end
        for end, default in ((settings.low_hz, LOW_HZ), (settings.high_hz, HIGH_HZ))
    )
    return (
        f"One trip of {settings.minutes:g} minutes at {settings.speed_m_per_s:g} m/s, track "
        f"{settings.track}, {low:g} to {high:g} Hz, noise of each sensor {settings.snr_db:g} dB "
        "below its signal. Largest Cramer-Rao bound of each kind of part over twelve trips, on "
        f"each of which one part is at {100 * WORN:g} %: one standard deviation in % of the part, "
        "no unbiased estimator has less. The spectra of mean, cross level and alignment of the "
        "track are unknown in every bin. Vehicle known: only its parts and its car-body mass are "
        f"unknown; learnt: all its numbers are, and {n_healthy} healthy trips came before. Three "
        "sensors do not determine the response to three inputs of unknown spectra: their bounds "
        "hold only where mean, cross level and alignment are independent of each other, and no "
        "estimator here reads parts from them."
    )
