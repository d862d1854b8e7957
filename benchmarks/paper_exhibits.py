"""Every figure and table of the paper, made again: pictures, tables, and a list of them.

python train.py experiment=table6 figures=false
python benchmarks/paper_exhibits.py outputs/table6/RUN

Writes fig*.png, table*.md and paper.csv into the folder of the multirun. Figures 1, 2 and 8 and the
recordings behind 4, 9 and 10 are of the authors' own train: simulated trips of the same vehicle
take their place.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import matplotlib as mpl
import paper_figures
import torch
from cells import Parser
from matplotlib.figure import Figure
from readings import METHODS
from sklearn.base import clone
from tabulate import tabulate

from suspnet.curves.curves import CurveSettings
from suspnet.curves.estimates import EstimateSettings
from suspnet.curves.extraction import MEASURES, PeakFeatures
from suspnet.curves.problem import Problem
from suspnet.curves.protocols import Task
from suspnet.estimation.checkpoint import load_model
from suspnet.estimation.trained import TrainedModel
from suspnet.estimation.trip_settings import TripSettings
from suspnet.ground.parameters import UNITS
from suspnet.ground.storage import read_json, write_atomically
from suspnet.runs.tables import MODEL_TITLES, in_digits, records_csv
from suspnet.runs.tensorboard import RunLog
from suspnet.runs.train import train
from suspnet.trains.jobs.fleet import FleetSettings, evaluate_fleet
from suspnet.trains.simulation import Fleet, Scenario, Simulation, write_fleet
from suspnet.vehicle import PARAMETERS, ResponseGenerator

LIST = Path(__file__).with_suffix(".csv")
"""What each exhibit of the paper shows, and where it is implemented."""
FONT_POINTS = 12
CLAIM_DB = 34.0
"""Noise of 2 %, from which on the paper's errors are below 10 % [dB]."""
SNR_DB = (26.0, 30.0, 34.0, 38.0, 42.0, 46.0, 50.0, 54.0)
"""Noise of Fig. 11, from 5 % to 0.2 % of the signal [dB]."""
WORN_SPRING = Scenario("worn_spring", {"k_p": {"from_km": 2.5e5, "to_km": 2.5e5, "ratio": 0.99}})
"""What the paper finds in Fig. 10."""
FLEET = Fleet(n_trips=15, minutes=10.0, rate_hz=500.0)
"""Half as many trips as the paper has, sampled more slowly, to be quick."""
CURVES_OF_TRIPS = EstimateSettings(
    n_train=2000, n_test=100, n_calibrate=500, method="H1", minutes=10.0, rates_hz=(500.0,) * 3
)
"""Training curves as `tfestimate` gives them from such trips."""
KERNEL_RANGES = {"C": "1 to 100", "sigma": "0.001 to 100", "epsilon": "1e-6 to 0.001"}
RANGES = {
    "msvr": KERNEL_RANGES,
    "svr": KERNEL_RANGES,
    "mvgpr": {
        "length_scale": "0.01 to 10",
        "signal_variance": "0.001 to 100",
        "noise_variance": "1e-4 to 0.1",
    },
}
"""Ranges of the paper's Table V."""
Rows = Sequence[Mapping[str, Any]]
Findings = dict[str, tuple[str, Rows]]
"""By exhibit: what was found here, and its table."""


@dataclass(frozen=True)
class Exhibit:
    """A figure or table of the paper: what it shows there and here, and where that is made.

    `home` is the file that implements it, `command` makes it alone, `picture` lies in the folder.
    """

    item: str
    paper: str
    ours: str
    home: str
    command: str
    picture: str = ""
    rows: Rows = ()

    @property
    def file(self) -> str:
        """Name of its files, such as fig05 or table5."""
        kind, number = self.item.split()
        if kind == "Table":
            return f"table{('I', 'II', 'III', 'IV', 'V', 'VI', 'VII').index(number) + 1}"
        return f"fig{int(number):02d}"


def write_paper(
    runs: Sequence[Mapping[str, Any]],
    folder: Path,
    *,
    fleet: Fleet = FLEET,
    of_trips: EstimateSettings = CURVES_OF_TRIPS,
    snr_db: Sequence[float] = SNR_DB,
) -> list[Exhibit]:
    """Make every exhibit from the jobs of a multirun of Table VI, list them, and return them.

    `runs` holds the metrics.json of the jobs in `folder`, which gets fig*.png, table*.md and
    paper.csv. `fleet` are the simulated trips, `of_trips` the training curves of the model
    that reads them, `snr_db` the noise of Fig. 11.
    """
    models = _models(folder)
    with mpl.rc_context({"font.size": FONT_POINTS}), RunLog(folder) as run_log:
        noisy = _at_noise_levels(models, snr_db, runs)
        for name, figure in _figures(models[0], noisy).items():
            run_log.figure(name, figure, folder)
        errors = _read_trips(models, fleet, of_trips, folder)
    findings = {
        **_vehicle_findings(models[0].generator),
        **_training_findings(models[0].task, runs),
        **_trip_findings(errors),
        "Fig. 11": (precision_words(noisy), ()),
    }
    exhibits = []
    for row in csv.DictReader(LIST.read_text(encoding="utf-8").splitlines()):
        exhibit = Exhibit(row["item"], row["paper"], row["ours"], row["home"], row["command"])
        ours, rows = findings.get(exhibit.item, (exhibit.ours, ()))
        picture = f"{exhibit.file}.png" if (folder / f"{exhibit.file}.png").exists() else ""
        exhibits.append(replace(exhibit, ours=ours, picture=picture, rows=rows))
        if rows:
            write_atomically(folder / f"{exhibit.file}.md", f"{tabulate(rows, 'keys', 'github')}\n")
    plain = [{k: v for k, v in vars(exhibit).items() if k != "rows"} for exhibit in exhibits]
    write_atomically(folder / "paper.csv", records_csv(plain))
    for exhibit in exhibits:
        print(f"{exhibit.item}: {exhibit.paper}\n    here: {exhibit.ours}")
    return exhibits


def _models(folder: Path) -> list[TrainedModel]:
    """Return the MSVR of each group, of one seed, or another method's if none was trained."""
    loaded = [load_model(path.parent) for path in sorted(folder.glob("*/model.json"), reverse=True)]
    models = [model for model in loaded if isinstance(model, TrainedModel)]
    name = "msvr" if any(model.name == "msvr" for model in models) else models[-1].name
    by_group = {model.task.group: model for model in models if model.name == name}
    return [by_group[group] for group in sorted(by_group)]


def _at_noise_levels(
    models: Sequence[TrainedModel], levels_db: Sequence[float], runs: Rows
) -> list[Mapping[str, Any]]:
    """Return the metrics of each model's method, trained and tested at each level of noise.

    Those of `runs` are taken as they are.
    """
    at_hand = {(run["group"], run["model"], run["seed"], run["snr_db"]): run for run in runs}
    metrics: list[Mapping[str, Any]] = []
    for model in models:
        seed = model.training["seed"]
        for snr_db in levels_db:
            run = at_hand.get((model.task.group, model.name, seed, snr_db))
            if run is None:
                settings = replace(model.settings, snr_db=snr_db)
                problem = Problem(model.generator, model.task, settings, seed)
                run = train(problem, clone(model.estimator))
            metrics.append(run)
    return metrics


def _figures(model: TrainedModel, noisy: Rows) -> dict[str, Figure]:
    """Return the figures that need no trips."""
    observer = model.settings.observer(model.generator)
    bins, features = observer.frequencies_hz, PeakFeatures()
    curve = observer.observe(torch.ones(1, len(PARAMETERS), dtype=torch.float64), seed=0)
    values = features.extract(curve, bins).values[0].tolist()
    peaks = dict(zip(features.names, values, strict=True))
    return {
        "fig03": paper_figures.quarter_car(model.vehicle),
        "fig05": paper_figures.bode(model.generator, bins),
        "fig06": paper_figures.peak_fits(bins.numpy(), curve[0].numpy(), peaks),
        "fig07": paper_figures.degradation(model.generator, bins),
        "fig11": paper_figures.sensitivity(noisy),
    }


def _read_trips(
    models: Sequence[TrainedModel], fleet: Fleet, of_trips: EstimateSettings, folder: Path
) -> dict[str, float]:
    """Simulate trips, read them as the paper does, and return the rms error of each output [%].

    Recordings become responses by H1 (`tfestimate`), these become peaks, and these become estimates
    of one model for all outputs. Model and report stay in the folder.
    """
    first, seed = models[0], models[0].training["seed"]
    outputs = tuple(name for model in models for name in model.task.outputs)
    task = replace(first.task, group="all", outputs=outputs)
    problem = Problem(first.generator, task, of_trips, seed)
    trained, report = folder / "trips" / "model", folder / "trips" / "report"
    train(problem, clone(first.estimator), trained, figures=False)
    with TemporaryDirectory() as work:
        trips = Path(work) / "trips"
        write_fleet(trips, Simulation(fleet, WORN_SPRING, first.generator, seed))
        settings = FleetSettings(TripSettings())
        evaluate_fleet(trips, [load_model(trained)], report, settings, progress=False)
    for name, drawn in (("fig04", "signals"), ("fig09", "responses"), ("fig10", "trend")):
        picture = (report / "figures" / f"{drawn}.png").read_bytes()
        write_atomically(folder / f"{name}.png", picture)
    errors: dict[str, float] = read_json(report / "metrics.json")["rms_error_percent"]
    return errors


def _vehicle_findings(generator: ResponseGenerator) -> Findings:
    """Return what follows from the vehicle alone."""
    bins, vehicle = CurveSettings().frequencies_hz(), generator.vehicle
    healthy = torch.ones(1, len(PARAMETERS), dtype=torch.float64)
    peaks = PeakFeatures().extract(generator.magnitudes(healthy, bins), bins).values[0]
    positions, heights, _ = peaks.reshape(3, 3).T.tolist()
    body, lower, upper = (f"{position:.2f}" for position in positions)
    levels = ", ".join(f"{20 * math.log10(height):.1f}" for height in heights)
    impact = impact_rows(generator)
    moved = ", ".join(f"{name} {impact[0][f'G_p {name} %']} %" for name in MEASURES)
    values = {"M_p": vehicle.bogie_mass_kg}
    values |= dict(zip(PARAMETERS, vehicle.healthy_values(), strict=True))
    numbers = [{"": name, "SI": f"{x:,.0f} {UNITS.get(name, 'kg')}"} for name, x in values.items()]
    rates = [{"sensor": name, "Hz": sensor.rate_hz} for name, sensor in Fleet().loggers().items()]
    return {
        "Fig. 5": (f"The same; peaks of {levels} dB (G_s, lower and upper one of G_p)", ()),
        "Fig. 6": (f"Two, at {lower} and {upper} Hz, and one, at {body} Hz", ()),
        "Fig. 7": (f"k_p halved: {moved}", impact),
        "Table II": ("Three of them at these rates, or pairs left and right", rates),
        "Table III": (f"{vehicle.name}, in N/m and N s/m, with which G_p and G_s follow", numbers),
        "Fig. 9": (f"Simulated trips: G_s has {body} Hz, G_p {lower} and {upper} Hz", ()),
    }


def impact_rows(generator: ResponseGenerator) -> list[dict[str, str]]:
    """Return how the largest peak of each curve changes [%] if a parameter halves or doubles."""
    features = PeakFeatures(("primary_largest", "secondary"))
    changes = [(j, ratio) for j in range(len(PARAMETERS)) for ratio in (0.5, 2.0)]
    ratios = torch.ones(1 + len(changes), len(PARAMETERS), dtype=torch.float64)
    for row, (j, ratio) in enumerate(changes, start=1):
        ratios[row, j] = ratio
    bins = CurveSettings().frequencies_hz()
    values = features.extract(generator.magnitudes(ratios, bins), bins).values
    percent = 100 * (values[1:] / values[0] - 1)
    names = [f"{curve} {name} %" for curve in ("G_p", "G_s") for name in MEASURES]
    return [
        {"varied": f"{PARAMETERS[j]} {ratio:.0%}"}
        | {name: f"{change:+.0f}" for name, change in zip(names, row, strict=True)}
        for (j, ratio), row in zip(changes, percent.tolist(), strict=True)
    ]


def _training_findings(task: Task, runs: Sequence[Mapping[str, Any]]) -> Findings:
    """Return the groups of simulations, the settings of the methods and MSVR's errors."""
    groups = [
        {"varied": ", ".join(names), "range": f"{task.lower:.0%} to {task.upper:.0%}", "curves": n}
        for names, n in zip(task.varied_sets, task.grid_sizes, strict=True)
    ]
    used = [
        {"group": run["group"], "method": MODEL_TITLES[run["model"]], "setting": name}
        | {"range in Table V": words, "used": run["training"]["parameters"][name]}
        for run in runs
        for name, words in RANGES.get(run["model"], {}).items()
    ]
    scores: dict[str, dict[str, float]] = {}
    for run in runs:
        for output, values in run["scores"].items():
            scores.setdefault(output, {})[MODEL_TITLES[run["model"]]] = values["mape_percent"]
    table = [
        {"MAPE %": output} | {name: in_digits(value) for name, value in row.items()}
        for output, row in scores.items()
    ]
    errors = ", ".join(in_digits(row.get("MSVR")) for row in scores.values())
    of_paper = [MODEL_TITLES[name] for name in METHODS]
    best = ", ".join(
        f"{min((row[method], method) for method in of_paper if method in row)[1]} for {output}"
        for output, row in scores.items()
    )
    return {
        "Table IV": (f"{' and '.join(f'{n:,}' for n in task.grid_sizes)} curves", groups),
        "Table V": ("The settings of Table VI, chosen within the same ranges", used),
        "Table VI": (f"MSVR {errors} %; best of four: {best}", table),
    }


def _trip_findings(errors: Mapping[str, float]) -> Findings:
    """Return whether a change of 1 % could be seen."""
    texts = ", ".join(f"{name} {error:.2g} %" for name, error in errors.items())
    seen = "could be seen" if errors.get("k_p", math.inf) < 1 else "is lost in it"
    return {"Fig. 10": (f"Simulated with that change; rms error {texts}: 1 % {seen}", ())}


def precision_words(noisy: Sequence[Mapping[str, Any]]) -> str:
    """Return the MAPE of each output at the coarsest and the finest precision.

    The paper has all of them below 10 % from 2 % on.
    """
    ordered = sorted(noisy, key=lambda run: run["snr_db"])
    ends = (f"{100 * 10 ** (-ordered[at]['snr_db'] / 20):.2g} %" for at in (0, -1))
    words, missed = [], []
    for output in dict.fromkeys(name for run in noisy for name in run["scores"]):
        own = [run for run in ordered if output in run["scores"]]
        mape = [run["scores"][output]["mape_percent"] for run in own]
        words.append(f"{output} {in_digits(mape[0])} to {in_digits(mape[-1])} %")
        precise = [m for m, run in zip(mape, own, strict=True) if run["snr_db"] >= CLAIM_DB]
        if max(precise, default=0.0) >= 10:
            missed.append(output)
    verdict = f"not below 10 % from 2 % on: {', '.join(missed)}" if missed else "as in the paper"
    return f"From a precision of {' to '.join(ends)}: {', '.join(words)}; {verdict}"


def main(argv: Sequence[str] | None = None) -> None:
    """Make the exhibits from the jobs of a multirun."""
    parser = Parser(description="Every figure and table of the paper, made again.")
    parser.add_argument("folder", type=Path, help="of a multirun of experiment=table6")
    folder = parser.parse_args(argv).folder
    runs = [read_json(path) for path in sorted(folder.glob("*/metrics.json"))]
    if not runs:
        parser.error(f"{folder} holds no job: give the folder of a multirun of experiment=table6")
    write_paper(runs, folder)


if __name__ == "__main__":
    main()
