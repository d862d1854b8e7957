"""Simulated trains: the trips of every suspension, each in a folder of its own."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from joblib import effective_n_jobs

from suspnet.dynamics import VerticalVehicle
from suspnet.ground.progress import bar
from suspnet.ground.storage import write_json
from suspnet.ground.workers import LostWorkerError, each
from suspnet.simulation.fleet import Fleet
from suspnet.simulation.folders import TRUTH, described, is_finished, own_folder, unfinished
from suspnet.simulation.scenarios import Scenario
from suspnet.simulation.trains import Suspension, Trains
from suspnet.simulation.writing import SimulatedVehicle, write_fleet


def write_trains(
    folder: Path,
    trains: Trains,
    fleet: Fleet,
    scenario: Scenario,
    generator: SimulatedVehicle,
    *,
    seed: int = 0,
    scatter: float = 0.0,
    n_jobs: int = 1,
    progress: bool = False,
) -> list[Path]:
    """Simulate the trips of every suspension of some trains.

    Each suspension has a subfolder, train_1_car_2_leading, as `write_fleet` writes it: a vehicle,
    pay-load and noise of its own that only the seed and its place decide, so that another train
    changes none of them. Those of a train share start, mileage, track and speed of each trip.
    ``truth.json`` in the folder itself says which of them wear. Until all are there
    ``unfinished.json`` says which simulation they are of: the same one goes on with the rest.

    Parameters
    ----------
    folder : Path
        Another one beside it, folder_2 or so, if a simulation is just writing to it.
    trains : Trains
    fleet : Fleet
        Of each suspension.
    scenario : Scenario
        What those that wear follow. The others keep its pay-load and spread, nothing wears.
    generator : SimulatedVehicle
        A ``VerticalVehicle`` is taken at the bogie of each suspension.
    seed : int
    scatter : float, [-]
        As `write_fleet` has it, of each suspension.
    n_jobs : int
        Suspensions at the same time.
    progress : bool

    Returns
    -------
    list of Path
        The suspensions' folders.

    Raises
    ------
    ValueError
        As `write_fleet`, or if the folder holds other trips.
    LostWorkerError
        If the processes that wrote a suspension were killed.
    """
    suspensions = trains.suspensions(seed)
    made_from = described(fleet, scenario, generator, seed, scatter, trains)
    write = functools.partial(
        _write, fleet=fleet, scenario=scenario, generator=generator, scatter=scatter
    )
    with own_folder(folder) as folder:
        missing = [one for one in suspensions if not is_finished(folder / one.name)]
        with unfinished(folder, made_from, trains.n_all, len(missing), "suspensions"):
            jobs = ((folder, one) for one in missing)
            done = each(write, jobs, effective_n_jobs(n_jobs))
            for _, outcome in bar(
                "suspensions", len(missing), items=done, unit="suspension", shown=progress
            ):
                if isinstance(outcome, LostWorkerError):
                    raise outcome
            write_json(folder / TRUTH, _truth(suspensions, trains, scenario, seed))
        return [folder / one.name for one in suspensions]


def _write(
    work: tuple[Path, Suspension],
    fleet: Fleet,
    scenario: Scenario,
    generator: SimulatedVehicle,
    scatter: float,
) -> None:
    """Simulate one suspension into its folder below a given one."""
    folder, one = work
    if not one.wears:
        scenario = replace(scenario, name="healthy", changes={})
    if isinstance(generator, VerticalVehicle):
        generator = replace(generator, bogie=one.aboard.bogie)
    write_fleet(
        folder / one.name,
        fleet,
        scenario,
        generator,
        seed=one.seed,
        scatter=scatter,
        aboard=one.aboard,
    )


def _truth(
    suspensions: Sequence[Suspension], trains: Trains, scenario: Scenario, seed: int
) -> dict[str, object]:
    """Return what the folder of the trains says of them."""
    return {
        **asdict(trains),
        "seed": seed,
        "scenario": scenario.name,
        "wearing": [one.name for one in suspensions if one.wears],
        "suspensions": [one.name for one in suspensions],
    }
