"""The files of a commissioned vehicle: a page, figures, numbers and curves."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from suspnet._version import __version__
from suspnet.estimation import commissioning_summary as words
from suspnet.estimation.commissioning import Commissioned
from suspnet.estimation.healthy_trips import HealthyTrips
from suspnet.estimation.physics import INCOMPLETE
from suspnet.ground.storage import printable, write_atomically, write_json
from suspnet.ground.tables import write_table
from suspnet.recordings.manifest import CHANNELS
from suspnet.report.figures import as_png, data_uri
from suspnet.report.templates import render
from suspnet.runs import commissioning_figures as figures

log = logging.getLogger(__name__)
NAME = "commissioning"
"""Base name of the files."""
CAPTIONS = {
    "responses": (
        "Measured and commissioned responses",
        "Above: by how much each suspension amplifies vibration of each frequency, and its phase, "
        "on the trip with the least noise. The commissioned vehicle should lie on the measured "
        "curve where its grey band is narrow. Below: the residual of each stretch (grey) and the "
        "rms of all (blue), over the noise; 1 is noise alone, and a peak far above it is a "
        "frequency at which the vehicle moves as the model cannot.",
    ),
    "numbers": (
        "Numbers before and after the trips",
        "Each bar is a median with one standard deviation to both sides, over the value of the "
        "drawing. A short blue bar is a number that the trips determine; a blue bar as long "
        "as the grey one is a number that they do not determine.",
    ),
}


def write_outcome(folder: Path, found: HealthyTrips, outcome: Commissioned) -> None:
    """Write page, numbers, curves and figures of a commissioned vehicle to a run's folder.

    commissioning.html is a self-contained page, commissioning.json its numbers,
    commissioning_responses.parquet and .csv its curves, a row a bin; figures are in figures/.
    """
    drawn = {
        "responses": figures.responses(found, outcome),
        "numbers": figures.number_ranges(words.numbers(outcome)),
    }
    for name, figure in drawn.items():
        write_atomically(folder / "figures" / f"{NAME}_{name}.png", as_png(figure))
    write_table(pa.concat_tables(_curves(found, outcome)), folder / f"{NAME}_responses")
    write_json(folder / f"{NAME}.json", as_json(found, outcome))
    page = _page(found, outcome, drawn)
    path = write_atomically(folder / f"{NAME}.html", page.encode("utf-8", errors="replace"))
    log.info("-> %s", path)


def training_notes(found: HealthyTrips, outcome: Commissioned) -> dict[str, Any]:
    """Return the healthy trips and their suspension, for a model's file."""
    place = asdict(found.manifests[0].place)
    mileage_km = [manifest.mileage_km for manifest in found.manifests]
    return {
        "n_trips": len(found.manifests),
        "misfit": outcome.misfit,
        "explained": words.is_explained(outcome),
        "mileage_km": [min(mileage_km), max(mileage_km)],
        "trips": [manifest.name for manifest in found.manifests],
        "place": {key: printable(text) for key, text in place.items()},
    }


def as_json(found: HealthyTrips, outcome: Commissioned) -> dict[str, Any]:
    """Return all numbers of a commissioned vehicle in SI units, for a file."""
    generator = outcome.generator
    return {
        "suspnet_version": __version__,
        "vehicle": generator.vehicle.name,
        "suspension": _place(found),
        "parts": list(generator.parts),
        "verdict": [words.verdict(found, outcome), *words.doubts(outcome)],
        "threshold": INCOMPLETE,
        "converged": outcome.converged,
        "n_starts": outcome.n_starts,
        "n_agree": outcome.n_agree,
        **training_notes(found, outcome),
        "trips": _trips(found, outcome),
        "left_out": list(found.left_out),
        "bogie_mass_kg": generator.vehicle.bogie_mass_kg,
        "numbers": [one.as_json() for one in words.numbers(outcome)],
    }


def _page(found: HealthyTrips, outcome: Commissioned, drawn: Mapping[str, Figure]) -> str:
    doubts, numbers = words.doubts(outcome), words.numbers(outcome)
    groups: dict[str, list[dict[str, Any]]] = {}
    for one in numbers:
        groups.setdefault(words.PART_TITLES[one.quantity.part], []).append(words.cells(one))
    vehicle = outcome.generator.vehicle
    return render(
        "commissioning.html",
        title=f"Commissioning of {vehicle.name}",
        headline=_headline(found, vehicle.name),
        mileage_km=training_notes(found, outcome)["mileage_km"],
        tone="notice" if doubts else "good",
        verdict=words.verdict(found, outcome),
        doubts=doubts,
        agreement="" if doubts else words.agreement(outcome),
        reference=words.reference(outcome),
        figures=[
            {"heading": heading, "explanation": text, "image": data_uri(drawn[name])}
            for name, (heading, text) in CAPTIONS.items()
        ],
        groups=groups,
        untold=words.untold(numbers),
        scale=words.force_scale(vehicle.bogie_mass_kg),
        trips=_trips(found, outcome),
        left_out=found.left_out,
        threshold=INCOMPLETE,
        details={
            "trips": str(found.manifests[0].path.parent),
            "parts": ", ".join(outcome.generator.parts) or "rigid bodies only",
            "suspnet": __version__,
            "date": datetime.now().astimezone().isoformat(timespec="seconds"),
        },
    )


def _headline(found: HealthyTrips, vehicle: str) -> dict[str, str]:
    pairs = [
        f"{channel.replace('_', ' ')} {'left and right' if pair else 'one'}"
        for channel, pair in zip(CHANNELS, found.paired, strict=True)
    ]
    left_out = f", {len(found.left_out)} left out" if found.left_out else ""
    return {
        "Vehicle": vehicle,
        "Suspension": _place(found),
        "Trips": f"{len(found.manifests)}{left_out}",
        "Sensors": ", ".join(pairs),
    }


def _place(found: HealthyTrips) -> str:
    return str(found.manifests[0].place)


def _trips(found: HealthyTrips, outcome: Commissioned) -> list[dict[str, Any]]:
    rows = []
    for i, manifest in enumerate(found.manifests):
        groups = [
            {
                "speed_m_per_s": group.speed_m_per_s,
                "n_averages": group.spectra.n_averages,
                "misfit": misfit,
            }
            for group, misfit in zip(found.groups, outcome.misfits, strict=True)
            if group.trip == i
        ]
        ratio = float(outcome.masses[i])
        rows.append(
            {
                "name": manifest.name,
                "mileage_km": manifest.mileage_km,
                "start": "" if manifest.start is None else manifest.start.isoformat(),
                "mass_ratio": ratio,
                "mass_kg": ratio * outcome.generator.vehicle.body_mass_kg,
                "groups": groups,
            }
        )
    return rows


def _curves(found: HealthyTrips, outcome: Commissioned) -> list[pa.Table]:
    left = figures.residuals(outcome)
    tables = []
    for i, group in enumerate(found.groups):
        n_bins = len(outcome.frequencies_hz)
        name = group.name.encode("utf-8", errors="replace").decode()  # as a file's may be
        columns: dict[str, Any] = {
            "trip": [name] * n_bins,
            "speed_m_per_s": np.full(n_bins, group.speed_m_per_s),
            "frequency_hz": outcome.frequencies_hz,
        }
        for link, suffix in enumerate(("p", "s")):
            for what in ("observed", "nominal", "fitted"):
                one = getattr(outcome, what)[i, link]
                columns[f"{what}_magnitude_{suffix}"] = np.abs(one)
                columns[f"{what}_phase_rad_{suffix}"] = np.angle(one)
            columns[f"deviation_{suffix}"] = outcome.deviations[i, link]
            columns[f"residual_over_noise_{suffix}"] = left[i, link]
        tables.append(pa.table(columns))
    return tables
