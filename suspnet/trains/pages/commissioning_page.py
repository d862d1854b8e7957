"""The files of a commissioned vehicle: a page, a figure and numbers."""

import logging
from collections.abc import Mapping
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from suspnet._version import __version__
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.estimation.flags import INCOMPLETE
from suspnet.estimation.relative_velocity import NOTE as VELOCITY
from suspnet.estimation.temperature import NOTE
from suspnet.ground.findings import Finding, together
from suspnet.ground.storage import printable, write_atomically, write_json
from suspnet.ground.types import ComplexArray, FloatArray
from suspnet.runs.figures import SUSPENSIONS, as_png, data_uri, say
from suspnet.runs.language import N_, gettext, spoken
from suspnet.trains.fits.bogie_fit import EXPLAINED
from suspnet.trains.fits.commissioning import Commissioned
from suspnet.trains.identification import commissioning_summary as words
from suspnet.trains.identification.healthy_trips import HealthyTrips
from suspnet.trains.pages.templates import write_page
from suspnet.trains.pages.trip_figures import band
from suspnet.trains.recordings.manifest import CHANNELS

log = logging.getLogger(__name__)
NAME = "commissioning"
"""Base name of the files."""
HEADINGS = {
    "responses": N_("Measured and commissioned responses"),
    "errors": N_("Errors of the model"),
}
"""Heading of each figure by its name."""
EXPLANATION = N_(
    "Above: by how much each suspension amplifies vibration of each frequency on the trip with the "
    "least noise. The commissioned vehicle should lie on the measured curve "
    "where its grey band is narrow."
)
RESIDUAL = N_(
    "Below: the residual of each stretch (grey) and the rms of all (blue), over the noise; 1 is "
    "noise alone, and a peak far above it is a frequency at which the vehicle moves as the model "
    "cannot."
)
ABOUT_ERRORS = N_(
    "How far off the model is at each sensor, as a percentage of the signal there. Where nothing "
    "is drawn, the healthy trips show no error. Where the error is large, a later trip counts less."
)
MEASURED, NOMINAL, FITTED = "0.7", "tab:orange", "tab:blue"


def write_outcome(
    folder: Path,
    healthy: HealthyTrips,
    outcome: Commissioned,
    bogie: CommissionedBogie | None = None,
) -> None:
    """Write page, numbers (JSON) and a figure of a commissioned vehicle.

    If each part is read, they are of the `bogie`, and the vehicle has its numbers.
    """
    figures = {}
    if healthy.groups:
        figures["responses"] = responses(healthy, outcome, with_residuals=bogie is None)
    if bogie is not None and bogie.errors is not None:
        figures["errors"] = errors(bogie, healthy.of_parts[0].frequencies_hz.numpy())
    for name, figure in figures.items():
        write_atomically(folder / "figures" / f"{NAME}_{name}.png", as_png(figure))
    write_json(folder / f"{NAME}.json", as_json(healthy, outcome, bogie))
    values = _page_values(healthy, outcome, figures, bogie)
    path = write_page(folder / f"{NAME}.html", "commissioning.html", **values)
    log.info("-> %s", path)


def training_notes(healthy: HealthyTrips, outcome: Commissioned) -> dict[str, Any]:
    """Return the healthy trips and their suspension, for a model's file."""
    place = asdict(healthy.manifests[0].place)
    mileage_km = [manifest.mileage_km for manifest in healthy.manifests]
    laws = {
        note: asdict(law)
        for note, law in ((NOTE, outcome.laws.temperature), (VELOCITY, outcome.laws.velocity))
        if law is not None
    }
    return laws | {
        "n_trips": len(healthy.manifests),
        "misfit": outcome.misfit,
        "explained": words.is_explained(outcome),
        "converged": outcome.converged,
        "mileage_km": [min(mileage_km), max(mileage_km)],
        "trips": [manifest.name for manifest in healthy.manifests],
        "place": {key: printable(text) for key, text in place.items()},
    }


def as_json(
    healthy: HealthyTrips, outcome: Commissioned, bogie: CommissionedBogie | None = None
) -> dict[str, Any]:
    """Return all numbers of a commissioned vehicle in SI units, for a file."""
    generator = outcome.generator
    verdict = [words.verdict(healthy, outcome), *healthy.doubts, *words.doubts(outcome)]
    if bogie is not None:
        verdict = [words.of_parts(bogie), *words.doubts_of_parts(bogie), *healthy.doubts]
    return {
        "suspnet_version": __version__,
        "vehicle": generator.vehicle.name,
        "suspension": str(healthy.manifests[0].place),
        "parts": list(generator.parts),
        "verdict": verdict,
        "threshold": INCOMPLETE,
        "n_starts": outcome.n_starts,
        "n_agree": outcome.n_agree,
        **training_notes(healthy, outcome),
        "trips": _trips(healthy, outcome),
        "left_out": list(healthy.left_out),
        "bogie_mass_kg": generator.vehicle.bogie_mass_kg,
        "numbers": [number.as_json() for number in words.numbers(outcome)],
    }


def _page_values(
    healthy: HealthyTrips,
    outcome: Commissioned,
    figures: Mapping[str, Figure],
    bogie: CommissionedBogie | None = None,
) -> dict[str, Any]:
    if bogie is None:
        verdict, threshold = words.verdict(healthy, outcome), INCOMPLETE
        doubts, calm = [*healthy.doubts, *words.doubts(outcome)], words.agreement(outcome)
        reach = ""
    else:
        verdict, threshold = words.of_parts(bogie), EXPLAINED
        doubts = [*healthy.doubts, *words.doubts_of_parts(bogie)]
        calm = words.errors_of_parts(bogie, healthy)
        reach = words.reach_of_parts(bogie)
    about = [EXPLANATION, RESIDUAL] if bogie is None else [EXPLANATION]
    explanations = {
        "responses": " ".join(map(gettext, about)),
        "errors": gettext(ABOUT_ERRORS),
    }
    # the numbers below a heading for each part of the vehicle that they describe
    numbers = words.numbers(outcome) + (words.further_numbers(bogie) if bogie else [])
    groups: dict[str, list[dict[str, Any]]] = {}
    for number in numbers:
        meaning = spoken(number.quantity.meaning)
        row = words.cells(number) | {"meaning": meaning[0].upper() + meaning[1:]}
        groups.setdefault(words.PART_TITLES[number.quantity.part], []).append(row)
    vehicle, n_left = outcome.generator.vehicle, len(healthy.left_out)
    n_trips = len(healthy.manifests)
    sensors: list[str] = [
        Finding("left-and-right" if pair else "one-sensor", channel=channel.replace("_", " "))
        for channel, pair in zip(CHANNELS, healthy.paired, strict=True)
    ]
    if healthy.vehicle is not None and healthy.vehicle.sensors and not healthy.groups:
        sensors = [place.replace("_", " ") for place in healthy.vehicle.sensors]
    return {
        "title": spoken(Finding("commissioning", name=vehicle.name)),
        "headline": {
            "Vehicle": vehicle.name,
            "Suspension": str(healthy.manifests[0].place),
            "Trips": Finding("trips-and-left-out", n=n_trips, n_left=n_left)
            if n_left
            else str(n_trips),
            "Sensors": together(sensors, ", "),
        },
        "mileage_km": training_notes(healthy, outcome)["mileage_km"],
        "of_parts": bogie is not None,
        "tone": "notice" if doubts else "good",
        "verdict": verdict,
        "doubts": doubts,
        "agreement": "" if doubts else calm,
        "reach": reach,
        "reference": words.reference(outcome),
        "figures": [
            {
                "id": name,
                "heading": gettext(HEADINGS[name]),
                "explanation": explanations[name],
                "image": data_uri(figure),
            }
            for name, figure in figures.items()
        ],
        "groups": groups,
        "untold": words.untold(numbers),
        "scale": words.force_scale(vehicle.bogie_mass_kg),
        "trips": _trips(healthy, outcome),
        "left_out": healthy.left_out,
        "threshold": threshold,
        "details": {
            "trips": str(healthy.manifests[0].path.parent),
            N_("parts"): ", ".join(outcome.generator.parts).replace("_", " ")
            or "rigid bodies only",
            "suspnet": __version__,
            "date": datetime.now().astimezone().isoformat(" ", "seconds"),
        },
    }


def errors(bogie: CommissionedBogie, frequencies_hz: FloatArray) -> Figure:
    """Return a figure of the errors of a bogie's responses by frequency."""
    assert bogie.errors is not None
    assert bogie.generator.sensors is not None
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for place, share in zip(bogie.generator.sensors, bogie.errors.numpy().T, strict=True):
        axes.plot(frequencies_hz, 100 * np.where(share > 0, share, np.nan), label=place)
    axes.set(xlabel="frequency [Hz]", ylabel=N_("error [% of the signal]"), yscale="log")
    axes.legend(fontsize="small", ncols=2)
    return figure


def _trips(healthy: HealthyTrips, outcome: Commissioned) -> list[dict[str, Any]]:
    """Return what page and JSON show of each trip."""
    rows = []
    for i, manifest in enumerate(healthy.manifests):
        stretches: list[tuple[Any, float | None]] = [
            (group, misfit)
            for group, misfit in zip(healthy.groups, outcome.misfits, strict=True)
            if group.trip == i
        ]
        if not healthy.groups:  # these trips show their parts only
            stretches = [(healthy.of_parts[i], None)]
        ratio = float(outcome.masses[i])
        rows.append(
            {
                "name": manifest.name,
                "mileage_km": manifest.mileage_km,
                "start": "" if manifest.start is None else manifest.start.isoformat(),
                "mass_ratio": ratio,
                "mass_kg": ratio * outcome.generator.vehicle.body_mass_kg,
                "groups": [
                    {
                        "speed_m_per_s": group.speed_m_per_s,
                        "n_averages": group.spectra.n_averages,
                        "misfit": misfit,
                    }
                    for group, misfit in stretches
                ],
            }
        )
    return rows


def residuals(outcome: Commissioned) -> FloatArray:
    """Return the rms of real and imaginary part of the residuals, over that of the noise.

    The shape is (n_groups, 2, n_freq); 1 is expected, NaN is a bin that is not used.
    """
    ratios = np.abs(1 - outcome.fitted / outcome.observed) / (np.sqrt(2) * outcome.deviations)
    return np.where(np.isfinite(outcome.deviations), ratios, np.nan)


def responses(healthy: HealthyTrips, outcome: Commissioned, *, with_residuals: bool) -> Figure:
    """Draw measured, nominal and commissioned responses of a trip, and all residuals if asked."""
    # one trip is drawn, that with the least noise: all of them would hide the band
    group = int(np.argmin(np.median(outcome.deviations, axis=(1, 2))))
    measured = healthy.groups[group]
    frequencies_hz, of_groups = outcome.frequencies_hz, residuals(outcome)
    heights = (3, 2) if with_residuals else (3,)
    figure = Figure(figsize=(9.0, 1.4 + sum(heights)), layout="constrained")
    axes = figure.subplots(
        len(heights), 2, sharex=True, sharey="row", height_ratios=heights, squeeze=False
    )
    km, km_per_h = healthy.manifests[measured.trip].mileage_km, 3.6 * measured.speed_m_per_s
    where = Finding("measured-at", km=km, km_per_h=km_per_h)
    curves: tuple[tuple[ComplexArray, str, dict[str, Any]], ...] = (
        (outcome.observed, where, {"color": MEASURED, "lw": 2.8}),
        (outcome.nominal, "vehicle of the drawing", {"color": NOMINAL, "lw": 1.2, "ls": "--"}),
        (outcome.fitted, "commissioned vehicle", {"color": FITTED, "lw": 1.0}),
    )
    for link, (title, column) in enumerate(zip(SUSPENSIONS, axes.T, strict=True)):
        magnitude = column[0]
        magnitude.set(title=title)
        ends = band(np.abs(outcome.observed[group, link]), outcome.deviations[group, link])
        style = {"color": MEASURED, "alpha": 0.4, "lw": 0, "label": "95 % band"}
        magnitude.fill_between(frequencies_hz, *ends, **style)
        for values, label, style in curves:
            magnitude.semilogy(frequencies_hz, np.abs(values[group, link]), label=label, **style)
        if with_residuals:
            _residuals(column[1], frequencies_hz, of_groups[:, link])
        column[-1].set_xlabel("frequency [Hz]")
    for axis in axes.flat:
        axis.margins(x=0)
        axis.grid(True, which="both", alpha=0.3)
    axes[0][0].set_ylabel("magnitude")
    if with_residuals:
        axes[1][0].set_ylabel("residual\nover the noise")
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    figure.align_ylabels(axes)
    return figure


def _residuals(axis: Axes, frequencies_hz: FloatArray, of_groups: FloatArray) -> None:
    """Draw the residual of each group as a thin line, and the rms of all groups."""
    is_used = np.isfinite(of_groups)
    if not is_used.any():
        say(axis, "no bin can be used", keep_x=True)
        return
    for residual in of_groups:
        axis.plot(frequencies_hz, residual, color="0.75", lw=0.5)
    count = is_used.sum(axis=0)
    total = np.where(is_used, of_groups, 0.0) ** 2
    rms = np.sqrt(total.sum(axis=0) / np.where(count, count, np.nan))
    axis.plot(frequencies_hz, rms, color=FITTED, lw=1.2, label="rms of all")
    axis.axhline(1, color="black", lw=0.8, ls=":")
    axis.set_ylim(0, max(3.0, 1.1 * float(np.nanmax(rms))))
    axis.legend(fontsize="small", loc="upper right")
