"""What MSVR does for a recording: errors of the fit of the curve from its estimate, and without it.

python benchmarks/starts.py [--seed 0] [--curves 32] [--train 2000]

The vehicle is that of the healthy trips of `one_way.py`'s pairs. Curves are drawn from what these
leave open; trips are the recordings with wear. Writes starts.csv.
"""

import csv
import tempfile
import time
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from one_way import KINDS, N_HEALTHY, RESULTS, Case, commissioned, written

import suspnet
from suspnet.estimation.from_curves import corrected
from suspnet.estimation.refine import refine
from suspnet.ground.tensors import threads
from suspnet.runs.fit import fit
from suspnet.runs.predict import refine_stream, regress_stream


def rms_percent(values, truth):
    """Return the rms error of each kind of part."""
    errors = np.log(values[:, :4] / truth[:, :4])
    return dict(zip(KINDS, 100 * np.sqrt(np.mean(errors**2, axis=0)), strict=True))


def timed(call, n):
    """Return the result of a call, and the seconds of one of its n rows."""
    start = time.process_time()
    found = call()
    return found, (time.process_time() - start) / n


@threads(1)
def read_curves(problem, model):
    """Return rows of the ways on test curves."""
    data = problem.features(suspnet.TEST).complete(problem.extractor)
    n = len(data.inputs)
    predicted, regress_s = timed(lambda: regress_stream(problem, model, data, suspnet.TEST), n)
    rows = [{"way": "MSVR alone", "seconds": regress_s} | rms_percent(predicted, data.outputs)]
    for way, start in (("fit from MSVR", predicted), ("fit from healthy", np.ones_like(predicted))):
        refined, each = timed(
            lambda start=start: refine_stream(problem, data, start, suspnet.TEST), n
        )
        values = refined.of(model.task.outputs)[0]
        rows.append({"way": way, "seconds": each} | rms_percent(values, data.outputs))
    return [{"data": "drawn curves", "n": n} | row for row in rows]


@threads(1)
def read_trips(problem, model, groups, worn):
    """Return rows of the ways on recordings."""
    results, seconds = {}, {}
    for group in groups:
        observer = problem.observer.at(group.speeds).without(group.left_out)
        curve = group.spectra.responses(problem.settings.method)[None]

        def regressed(observer=observer, curve=curve):
            inputs = model.features(observer.for_features(curve), observer.frequencies_hz)[0]
            return corrected(model, observer, model.predict(inputs), 3)

        predicted, each = timed(regressed, 1)
        results.setdefault("MSVR alone", []).append(predicted[0])
        seconds.setdefault("MSVR alone", []).append(each)
        starts = {"fit from MSVR": predicted, "fit from healthy": np.ones_like(predicted)}
        for way, start in starts.items():

            def fitted(observer=observer, start=start, spectra=group.spectra):
                misfit = observer.measured_misfit(spectra)
                return refine(model.task, misfit, start, directions=observer.directions)

            found, each = timed(fitted, 1)
            results.setdefault(way, []).append(found.of(model.task.outputs)[0][0])
            seconds.setdefault(way, []).append(each)
    return [
        {"data": "recordings", "n": len(worn), "way": way, "seconds": np.median(seconds[way])}
        | rms_percent(np.array(values), worn)
        for way, values in results.items()
    ]


def main():
    parser = ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the train")
    parser.add_argument("--trips", type=int, default=6, help="with wear")
    parser.add_argument("--curves", type=int, default=32, help="that are drawn")
    parser.add_argument("--train", type=int, default=2000, help="curves that MSVR learns from")
    options = parser.parse_args()
    torch.set_num_threads(1)
    case = Case("pairs", 20.0, "fast", options.seed)
    with tempfile.TemporaryDirectory() as folder:
        worn = written(case, options.trips, Path(folder))
        settings, outcome, groups, _ = commissioned(case, Path(folder))
    settings = replace(settings, n_train=options.train, n_test=options.curves)
    task = suspnet.read_protocol("trips").task("all")
    problem = suspnet.Problem(outcome.generator, task, settings)
    start = time.process_time()
    estimator = suspnet.MSVR(C=1e6, sigma=16.0, epsilon=1e-3, n_components=2048)
    model = replace(fit(problem, estimator, None), corrected=True)
    train_s = time.process_time() - start
    later = [group for group in groups if group.trip >= N_HEALTHY]
    rows = read_curves(problem, model) + read_trips(problem, model, later, worn)
    with (RESULTS / "starts.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, ["train_s", *rows[0]], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            known = {k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()}
            writer.writerow({"train_s": f"{train_s:.0f}"} | known)
            print(known, flush=True)


if __name__ == "__main__":
    main()
