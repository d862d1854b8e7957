"""Results of the check of trips, and their text, JSON, page and pictures."""

import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from suspnet._version import __version__
from suspnet.curves.cross_spectra import CrossSpectra
from suspnet.estimation.trip_settings import LEAST_TRIPS, N_HEALTHY
from suspnet.ground.findings import Finding, at, together
from suspnet.ground.records import Place
from suspnet.ground.storage import printable, write_json
from suspnet.ground.wording import files_of, span
from suspnet.runs.figures import as_png, say
from suspnet.runs.language import spoken
from suspnet.runs.tables import narrow
from suspnet.trains.identification.commissioning_summary import hardest_losses
from suspnet.trains.pages.templates import write_page
from suspnet.trains.pages.trip_figures import CHANNEL_TITLES, draw_signals
from suspnet.trains.recordings.recording import Recording, overview
from suspnet.trains.trips.grouping import lone_trains

READY, TOO_LITTLE, PROBLEM = "ready", "too little", "problem"
"""States of a trip: it is readable by the given models, or without any by a model of its speed; too
little of it can be used; it cannot be opened, or its channels are swapped."""
PARTLY = "partly checked"
"""What is shown of a trip that is ready as far as it could be checked without its vehicle."""
NEED_A_VEHICLE = "units, signs, swapped sensors and the direction of travel"
"""What can be checked only against the numbers of the vehicle."""
TABLE_WIDTH = 100  # width of the table of trips, that of a terminal, [characters]
LISTED = 5  # largest number of trips that are listed for one problem
TONES = {READY: "good", PARTLY: "notice", TOO_LITTLE: "notice", PROBLEM: "act"}
"""Tone of each state that is shown, the worst last; the page's style sheet has the colours."""


@dataclass(frozen=True)
class SteadyPart:
    """Quality of a trip's segments at one speed.

    `n_averages` counts independent averages. Coherences are means over the vehicle's band, of axle
    box and bogie and of bogie and body. `deviation_percent` is the standard deviation of the
    log-magnitude of the less certain response, median over the band. They are NaN where nothing but
    each part is read.
    """

    speed_m_per_s: float
    n_averages: float
    coherence_p: float
    coherence_s: float
    deviation_percent: float


@dataclass(frozen=True)
class TripCheck:
    """What is wrong with one trip, and how much of it can be used.

    `problems` state why the trip cannot be read, without the manifest's path. `remarks` are faults
    of sensors, parts that could not be checked, and why there is too little. `sensors` names the
    channels that are pairs of sensors; `sources` are file and column of each sensor.
    `usable_percent` is the share of the recording without faults, `steady_percent` the share of its
    segments that belong to `parts`, which are the speeds with enough averages, the longest first.
    `band_hz` is where the vehicle's responses are read, and `read_by` the speeds of the models that
    decide whether the trip is ready, empty without models. `unchecked`: the vehicle's numbers are
    not known, so that ``NEED_A_VEHICLE`` are not checked. `shows_parts`: each part of the bogie can
    be read, as far as was checked; `least_losses` are those from which a trip like this would name
    each (`expected_losses`), empty where they were not computed. `label` is its name among trips of
    several folders, `frame_sensor` where the frame's sensor looks to be. `is_rig`: it is a record
    of a rig.
    """

    manifest: Path
    state: str = PROBLEM
    problems: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    vehicle: str = ""
    place: Place = field(default_factory=Place)
    mileage_km: float = np.nan
    sensors: str = ""
    duration_s: float = np.nan
    usable_percent: float = np.nan
    band_hz: tuple[float, float] = (np.nan, np.nan)
    parts: tuple[SteadyPart, ...] = ()
    steady_percent: float = np.nan
    sources: tuple[str, ...] = ()
    picture: str = ""
    read_by: str = ""
    unchecked: bool = False
    shows_parts: bool = False
    least_losses: Mapping[str, float] = field(default_factory=dict)
    label: str = ""
    frame_sensor: str = "axle"
    is_rig: bool = False

    @property
    def shown(self) -> str:
        """State as it is shown, which says if a trip that is ready was checked in part only."""
        return PARTLY if self.state == READY and self.unchecked else self.state

    @property
    def name(self) -> str:
        """Name of the trip; bytes that are not UTF-8 are shown in hex."""
        return self.label or printable(self.manifest.stem)

    @property
    def n_averages(self) -> float:
        """Independent averages at all steady speeds together."""
        return sum(part.n_averages for part in self.parts)

    @property
    def words(self) -> str:
        """Amount and quality of usable data, on one line."""
        averages = (
            Finding("averages-at", n_averages=p.n_averages, speed_m_per_s=p.speed_m_per_s)
            for p in self.parts
        )
        speeds = together(averages, ", ") or "no steady part"
        values = {"usable_percent": self.usable_percent, "sensors": self.sensors}
        return Finding("usable", speeds=speeds, **values)

    def row(self) -> dict[str, Any]:
        """Return the check as JSON-able values."""
        return asdict(self) | {
            "manifest": printable(str(self.manifest)),
            "n_averages": self.n_averages,
        }


def with_distinct_names(checks: Sequence[TripCheck]) -> list[TripCheck]:
    """Return checks in which trips of the same name are called FOLDER/NAME."""
    folders: dict[str, list[Path]] = {}
    for check in checks:
        folders.setdefault(check.name, []).append(check.manifest.absolute().parent)
    named = []
    for check in checks:
        if len(same_name := folders[check.name]) > 1:
            below = check.manifest.absolute().parent.relative_to(os.path.commonpath(same_name))
            check = replace(check, label=printable((below / check.name).as_posix()))
        named.append(check)
    return named


def with_shared_data(checks: Sequence[TripCheck]) -> list[TripCheck]:
    """Return checks with a remark if an earlier trip has a sensor of the same file and column.

    This is the usual mistake when a manifest is copied.
    """
    owners: dict[str, str] = {}
    remarked = []
    for check in checks:
        if others := dict.fromkeys(owners[source] for source in check.sources if source in owners):
            remark = Finding("same-data", others=together(list(others)[:LISTED], ", "))
            check = replace(check, remarks=(*check.remarks, remark))
        remarked.append(check)
        owners = dict.fromkeys(check.sources, check.name) | owners
    return remarked


def suspensions(checks: Iterable[TripCheck]) -> dict[str, list[TripCheck]]:
    """Return the trips whose manifests could be read, by vehicle and place."""
    by_title: dict[str, list[TripCheck]] = {}
    for check in checks:
        if check.vehicle:
            title = together((check.vehicle, str(check.place)), ", ")
            by_title.setdefault(title, []).append(check)
    return dict(sorted(by_title.items()))


def suspension_sentences(checks: Sequence[TripCheck]) -> list[str]:
    """Return how much data commissioning and reading of one suspension would have."""
    ready = [check for check in checks if check.state == READY]
    words: list[str] = [
        Finding("some-ready", n_ready=len(ready), trips=Finding("trips", n=len(checks)))
    ]
    speeds = [part.speed_m_per_s for check in ready for part in check.parts]
    if speeds:
        km = _ends([check.mileage_km for check in ready], 0)
        words[0] = Finding("ready-at", ready=words[0], km=km, speeds=_ends(speeds, 1))
        words[0] = together((words[0], ready[0].read_by), ": ")
    if len(ready) < LEAST_TRIPS:
        words.append(Finding("more-trips-needed", least_trips=LEAST_TRIPS))
    kinds = sorted({check.sensors for check in ready})
    if len(kinds) > 1:
        words.append(Finding("sensors-differ", kinds=together(kinds, "; ")))
    if seen := next((check for check in ready if check.least_losses), None):
        hardest = hardest_losses(seen.least_losses)
        words.append(Finding("would-name-from", trip=seen.name, n=N_HEALTHY, **hardest))
    return words


def train_words(checks: Iterable[TripCheck]) -> list[str]:
    """Return a sentence on each vehicle with several suspensions whose manifests name no train."""
    alone = lone_trains((check.vehicle, check.place) for check in checks)
    return [
        at(vehicle, "suspensions-without-train", n_several=len(several))
        for vehicle, several in alone.items()
        if vehicle
    ]


USABLE = (
    "usable: share without faults; steady: share of that in stretches at one speed that are long "
    "and certain enough for an estimate"
)
"""Explanation of two columns of the table, where they differ."""


def _ends(values: Sequence[float], digits: int) -> str:
    return span(*(f"{of(values):.{digits}f}" for of in (min, max)))


def verdict(checks: Sequence[TripCheck], elsewhere: Sequence[str]) -> str:
    """Return how many trips are in which state, on one line."""
    counts = Counter(check.shown for check in checks)
    n_ready = counts[READY] + counts[PARTLY]
    kinds = {"only-partly": counts[PARTLY], "read-but-little": counts[TOO_LITTLE]}
    kinds |= {"with-problems": counts[PROBLEM], "lead-to-no-trip": len(elsewhere)}
    others = [Finding(kind, n=n) for kind, n in kinds.items() if n]
    return together((Finding("ready-for-estimate", n_ready=n_ready, n=len(checks)), *others), ", ")


def summary(checks: Sequence[TripCheck], elsewhere: Sequence[str] = ()) -> str:
    """Return all checks as text: verdict, table of the trips that could be read, all problems.

    `elsewhere` are problems outside the trips.
    """
    lines = [verdict(checks, elsewhere)]
    # of a trip that was not read the problem is listed below
    if read := [check for check in checks if np.isfinite(check.duration_s)]:
        lines.append(_table(read))
    if any(check.steady_percent < check.usable_percent for check in checks):
        lines.append(USABLE)
    for title, several in suspensions(checks).items():
        lines += ["", f"{title}: {'; '.join(suspension_sentences(several))}"]
    lines += train_words(checks)
    # trips of a folder tend to have the same faults: each is said once
    problems = _by_words((check.name, check.problems) for check in checks)
    remarks = _by_words((check.name, check.remarks) for check in checks)
    for title, listed in (
        ("Problems", [*elsewhere, *(f"{names}: {words}" for words, names in problems)]),
        ("Remarks", [f"{names}: {words}" for words, names in remarks]),
    ):
        if listed:
            lines += ["", f"{title}:", *(f"  {line}" for line in listed)]
    return "\n".join(lines)


def _table(checks: Sequence[TripCheck]) -> str:
    """Return a row for each trip; a name too long for the width of a terminal loses its start."""
    header = ["min", "usable %", "steady %", "m/s", "averages", "coherence", "state"]
    rows = []
    for check in checks:
        speeds = [part.speed_m_per_s for part in check.parts]
        coherences = [(p.coherence_p, p.coherence_s) for p in check.parts[:1]]
        rows.append(
            [
                f"{check.duration_s / 60:.1f}",
                f"{check.usable_percent:.1f}",
                f"{check.steady_percent:.0f}" if np.isfinite(check.steady_percent) else "",
                _ends(speeds, 0) if speeds else "",
                f"{check.n_averages:.0f}",
                "".join(f"{p:.2f}, {s:.2f}" for p, s in coherences if np.isfinite(p)),
                check.shown,
            ]
        )
    room = TABLE_WIDTH - len(narrow(rows, header).splitlines()[0]) - len(" | ")
    names = [c.name if len(c.name) <= room else f"…{c.name[1 - room :]}" for c in checks]
    return narrow([[n, *row] for n, row in zip(names, rows, strict=True)], ["trip", *header])


def _by_words(remarks: Iterable[tuple[str, Sequence[str]]]) -> list[tuple[str, str]]:
    """Return each sentence once with its trips, in the order of the trips.

    How files are read is one sentence for all files that are read alike, with their number.
    """
    names: dict[str, list[str]] = {}
    n_files: Counter[str] = Counter()
    for name, sentences in remarks:
        for sentence in sentences:
            files = files_of(sentence)
            for words, n in (files if any(files.values()) else {sentence: 0}).items():
                n_files[words] += n
                names.setdefault(words, []).append(name)
    listed = []
    for words, trips in names.items():
        more = f" and {len(trips) - LISTED} more" if len(trips) > LISTED else ""
        if n_files[words]:
            words = Finding("read-alike", words=words, n=n_files[words])
        listed.append((words, ", ".join(trips[:LISTED]) + more))
    return listed


def write_checks(checks: Sequence[TripCheck], elsewhere: Sequence[str], output: Path) -> Path:
    """Write check.json and the page check.html; return the path of the page."""
    shared: dict[str, Any] = {
        "verdict": verdict(checks, elsewhere),
        "suspensions": {
            title: suspension_sentences(several) for title, several in suspensions(checks).items()
        },
    }
    content = {"suspnet_version": __version__, "problems": list(elsewhere)}
    write_json(output / "check.json", content | shared | {"trips": [c.row() for c in checks]})
    worst = max((check.shown for check in checks), key=list(TONES).index, default=PROBLEM)
    # how files were read is no fault of a trip: it is said once, below the table
    on_files = [[s for s in check.remarks if any(files_of(s).values())] for check in checks]
    names = [check.name for check in checks]
    return write_page(
        output / "check.html",
        "check.html",
        title=spoken("Check of recordings"),
        tone=TONES[PROBLEM if elsewhere else worst],
        elsewhere=elsewhere,
        trains=train_words(checks),
        checks=checks,
        findings=[
            [s for s in check.remarks if s not in of_file]
            for check, of_file in zip(checks, on_files, strict=True)
        ],
        read_as=[words for words, _ in _by_words(zip(names, on_files, strict=True))],
        tones=TONES,
        **shared,
    )


LINKS = ("axle box to bogie frame", "bogie frame to car body")
DPI = 110


def trip_figure(
    recording: Recording,
    frequencies_hz: Tensor,
    spectra: CrossSpectra | None,
    band_hz: tuple[float, float],
    title: str,
) -> bytes:
    """Return a PNG: signals and speed of a recording in windows, spectra, coherence with the band.

    `frequencies_hz`: (n_freq,) [Hz]; `spectra`: (3, n_freq), None if no stretch is free of faults.
    """
    # not "constrained", which takes two thirds of the time of drawing
    figure = Figure(figsize=(12.0, 7.0))
    figure.suptitle(spoken(title), fontsize="medium")
    columns: Any = figure.subfigures(1, 2, width_ratios=(1.15, 1.0))
    left, right = columns
    axes: list[Axes] = list(left.subplots(4, 1, sharex=True))
    left.subplots_adjust(left=0.13, right=0.98, top=0.88, bottom=0.08, hspace=0.12)
    draw_signals(axes, overview(recording))
    handles = axes[0].get_legend_handles_labels()
    left.legend(*handles, loc="upper center", bbox_to_anchor=(0.55, 0.945), ncols=3)
    left.align_ylabels(axes)
    upper, lower = right.subplots(2, 1, sharex=True)
    right.subplots_adjust(left=0.13, right=0.98, top=0.89, bottom=0.08, hspace=0.16)
    upper.set(ylabel="power density [(m/s²)²/Hz]", title="spectra")
    lower.set(ylabel="coherence", title="coherence", xlabel="frequency [Hz]", ylim=(0, 1.05))
    if spectra is None:
        for axis in (upper, lower):
            say(axis, "no stretch is long enough and free of faults")
        return as_png(figure, DPI)
    hertz = frequencies_hz.numpy()
    for title, density in zip(CHANNEL_TITLES, spectra.auto.numpy(), strict=True):
        upper.semilogy(hertz[1:], np.where(density > 0, density, np.nan)[1:], label=title, lw=1)
    for title, coherence in zip(LINKS, spectra.coherences().numpy(), strict=True):
        lower.plot(hertz[1:], coherence[1:], label=title, lw=1)
    for axis, place in ((upper, "lower left"), (lower, "lower right")):
        axis.axvspan(*band_hz, color="tab:green", alpha=0.08, lw=0, label="vehicle's band")
        axis.margins(x=0)
        axis.grid(True, which="major", alpha=0.3)
        axis.legend(loc=place, fontsize="small")
    return as_png(figure, DPI)
