"""The files of a commissioned vehicle: a page, a figure and numbers."""

import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from suspnet._version import __version__
from suspnet.estimation.commissioned_bogie import CommissionedBogie
from suspnet.ground.findings import Finding, together
from suspnet.ground.storage import printable, write_atomically, write_json
from suspnet.ground.types import FloatArray
from suspnet.runs.figures import SUSPENSIONS, as_png, data_uri
from suspnet.runs.language import N_, spoken
from suspnet.trains.fits.bogie_fit import EXPLAINED
from suspnet.trains.fits.commissioning import Commissioned
from suspnet.trains.fits.explained_trips import ExplainedTrip, explained_trips
from suspnet.trains.identification import commissioning_summary as words
from suspnet.trains.identification.healthy_trips import HealthyTrips
from suspnet.trains.pages.templates import write_page
from suspnet.trains.pages.trip_figures import band
from suspnet.trains.recordings.manifest import CHANNELS
from suspnet.trains.spectra.subspace import SpectralMatrix

log = logging.getLogger(__name__)
NAME = "commissioning"  # base name of the files
MEASURED, NOMINAL, FITTED = "0.7", "tab:orange", "tab:blue"


def write_outcome(folder: Path, healthy: HealthyTrips, outcome: Commissioned) -> None:
    """Write page, numbers (JSON) and figures of a commissioned vehicle."""
    bogie, celsius = outcome.bogie, [one.temperature_c for one in healthy.manifests]
    commissioned, drawing = (
        explained_trips(vehicle, bogie, healthy.of_parts, celsius)
        for vehicle in (bogie.generator, healthy.vehicle)
    )
    figures = {"responses": responses(healthy, commissioned, drawing)}
    if bogie.errors is not None and bool(bogie.errors.any()):
        frequencies_hz = healthy.of_parts[0].frequencies_hz.numpy()
        figures["errors"] = errors(bogie, frequencies_hz)
    for name, figure in figures.items():
        write_atomically(folder / "figures" / f"{NAME}_{name}.png", as_png(figure))
    misfits = [trip.misfit for trip in commissioned]
    numbers = as_json(healthy, outcome, misfits)
    write_json(folder / f"{NAME}.json", numbers)
    shared = {name: numbers[name] for name in ("reach", "trips")}
    values = _page_values(healthy, outcome, figures) | shared
    path = write_page(folder / f"{NAME}.html", "commissioning.html", **values)
    log.info("-> %s", path)


def training_notes(healthy: HealthyTrips, outcome: Commissioned) -> dict[str, Any]:
    """Return the healthy trips and their suspension, for a model's file."""
    bogie = outcome.bogie
    place = asdict(healthy.manifests[0].place)
    mileage_km = [manifest.mileage_km for manifest in healthy.manifests]
    return {
        "n_trips": len(healthy.manifests),
        "misfit": bogie.misfit,
        "explained": bogie.misfit <= EXPLAINED,
        "converged": bogie.converged,
        "mileage_km": [min(mileage_km), max(mileage_km)],
        "trips": [manifest.name for manifest in healthy.manifests],
        "place": {key: printable(text) for key, text in place.items()},
    }


def as_json(
    healthy: HealthyTrips, outcome: Commissioned, misfits: Sequence[float]
) -> dict[str, Any]:
    """Return all numbers of a commissioned vehicle in SI units, for a file.

    `misfits` are those of its trips.
    """
    generator, bogie = outcome.generator, outcome.bogie
    numbers = words.numbers(outcome) + words.further_numbers(bogie)
    return {
        "suspnet_version": __version__,
        "vehicle": generator.vehicle.name,
        "suspension": str(healthy.manifests[0].place),
        "parts": list(generator.parts),
        "verdict": [words.of_parts(bogie), *words.doubts_of_parts(bogie), *healthy.doubts],
        "errors": words.errors_of_parts(bogie, healthy),
        "reach": words.reach_of_parts(bogie),
        "threshold": EXPLAINED,
        **training_notes(healthy, outcome),
        **({} if bogie.law is None else {"suspension_law": asdict(bogie.law)}),
        "trips": _trips(healthy, outcome, misfits),
        "left_out": list(healthy.left_out),
        "bogie_mass_kg": generator.vehicle.bogie_mass_kg,
        "numbers": [number.as_json() for number in numbers],
    }


def _page_values(
    healthy: HealthyTrips, outcome: Commissioned, figures: Mapping[str, Figure]
) -> dict[str, Any]:
    bogie = outcome.bogie
    doubts = [*healthy.doubts, *words.doubts_of_parts(bogie)]
    # the numbers below a heading for each part of the vehicle that they describe
    numbers = words.numbers(outcome) + words.further_numbers(bogie)
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
    if healthy.absent and healthy.vehicle.places:
        sensors = [place.replace("_", " ") for place in healthy.vehicle.places]
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
        "tone": "notice" if doubts else "good",
        "verdict": words.of_parts(bogie),
        "doubts": doubts,
        "agreement": "" if doubts else words.errors_of_parts(bogie, healthy),
        "reference": words.reference(outcome),
        "figures": {name: data_uri(figure) for name, figure in figures.items()},
        "groups": groups,
        "untold": words.untold(numbers),
        "scale": Finding("force-scale", bogie_mass_kg=vehicle.bogie_mass_kg),
        "left_out": healthy.left_out,
        "threshold": EXPLAINED,
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
    figure = Figure(figsize=(8, 4), layout="constrained")
    axes = figure.subplots()
    for place, share in zip(bogie.generator.places, bogie.errors.numpy().T, strict=True):
        axes.plot(frequencies_hz, 100 * np.where(share > 0, share, np.nan), label=place)
    axes.set(xlabel="frequency [Hz]", ylabel=N_("error [% of the signal]"), yscale="log")
    axes.legend(fontsize="small", ncols=2)
    return figure


def _trips(
    healthy: HealthyTrips, outcome: Commissioned, misfits: Sequence[float]
) -> list[dict[str, Any]]:
    """Return what page and JSON show of each trip."""
    loads_m, masses = outcome.bogie.loads_m, outcome.bogie.masses.tolist()
    return [
        {
            "name": manifest.name,
            "mileage_km": manifest.mileage_km,
            "start": "" if manifest.start is None else manifest.start.isoformat(),
            "mass_ratio": masses[i],
            "mass_kg": masses[i] * outcome.generator.vehicle.body_mass_kg,
            "centre_m": [] if loads_m is None else loads_m[i].tolist(),
            "speed_m_per_s": trip.speed_m_per_s,
            "n_averages": trip.spectra.n_averages,
            "misfit": misfits[i],
        }
        for i, (manifest, trip) in enumerate(zip(healthy.manifests, healthy.of_parts, strict=True))
    ]


def responses(
    healthy: HealthyTrips, commissioned: Sequence[ExplainedTrip], drawing: Sequence[ExplainedTrip]
) -> Figure:
    """Draw what a trip's suspensions amplify: measured, commissioned and by the drawing."""
    # one trip is drawn: all of them would hide the band
    i = max(range(len(commissioned)), key=lambda i: healthy.of_parts[i].spectra.n_averages)
    trip, frequencies_hz = healthy.of_parts[i], healthy.of_parts[i].frequencies_hz.numpy()
    ends = links(healthy.vehicle.places)
    figure = Figure(figsize=(9.0, 4.4), layout="constrained")
    axes = figure.subplots(1, len(ends), sharex=True, sharey=True, squeeze=False)[0]
    km, km_per_h = healthy.manifests[i].mileage_km, 3.6 * trip.speed_m_per_s
    where = Finding("measured-at", km=km, km_per_h=km_per_h)
    curves: tuple[tuple[SpectralMatrix, str, dict[str, Any]], ...] = (
        (trip.spectra, where, {"color": MEASURED, "lw": 2.8}),
        (drawing[i].expected, "vehicle of the drawing", {"color": NOMINAL, "lw": 1.2, "ls": "--"}),
        (commissioned[i].expected, "commissioned vehicle", {"color": FITTED, "lw": 1.0}),
    )
    for (title, both), axis in zip(ends.items(), axes, strict=True):
        axis.set(title=title, xlabel="frequency [Hz]")
        magnitudes, deviations = amplified(trip.spectra, both)
        if trip.left_out is not None:  # other signals: there is no band
            deviations[trip.left_out.numpy()] = math.inf
        low_high = band(magnitudes, deviations)
        style = {"color": MEASURED, "alpha": 0.4, "lw": 0, "label": "95 % band"}
        axis.fill_between(frequencies_hz, *low_high, **style)
        for spectra, label, style in curves:
            axis.semilogy(frequencies_hz, amplified(spectra, both)[0], label=label, **style)
        axis.margins(x=0)
        axis.grid(True, which="both", alpha=0.3)
    axes[0].set_ylabel("magnitude")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return figure


def links(sensors: Sequence[str]) -> dict[str, FloatArray]:
    """Return the title of each suspension with sensors at both ends, and their weights (2, m).

    They are the means of the sensors at axle 1, of axle box and frame, and of frame and body.
    """

    def mean(kind: str) -> FloatArray:
        at = np.array([name.startswith(kind) and "axle2" not in name for name in sensors], float)
        return np.asarray(at / max(1.0, at.sum()))

    pairs = (("axle_box", "frame"), ("frame", "body"))
    weights = [np.stack([mean(kind) for kind in pair]) for pair in pairs]
    return {
        title: both
        for title, both in zip(SUSPENSIONS, weights, strict=True)
        if both.any(axis=1).all()
    }


def amplified(spectra: SpectralMatrix, both: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return |S_yx| / S_xx of the upper y and the lower end x, and the deviation of its logarithm.

    With the coherence g^2 and n averages the deviation is ((1 - g^2) / (2 n g^2))^1/2 (Bendat and
    Piersol, 2010, table 9.6); both have the shape (n_freq,).
    """
    values = both @ spectra.values.numpy() @ both.T
    powers, cross = values.diagonal(axis1=1, axis2=2).real, np.abs(values[:, 1, 0])
    with np.errstate(divide="ignore", invalid="ignore"):  # bins without any signal
        coherence = cross**2 / powers.prod(axis=1)
        square = np.clip(1 - coherence, 0, None) / (2 * spectra.n_averages * coherence)
        return cross / powers[:, 0], np.sqrt(square)
