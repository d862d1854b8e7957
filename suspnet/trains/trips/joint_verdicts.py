"""What several trips in a row name as worn, where the last one alone does not."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from suspnet.estimation.bogie_model import BogieModel
from suspnet.estimation.fitted import Model
from suspnet.ground.findings import WORN, Finding, kind_is, parts_of, together
from suspnet.ground.parameters import BOGIE_PARTS
from suspnet.ground.records import OK, TripResult
from suspnet.trains.fits.joint_estimate import joint_estimate
from suspnet.trains.fits.worn_parts import worn_parts
from suspnet.trains.maintenance.series import N_LAST
from suspnet.trains.trips.commissionings import since_km


def with_joint_verdicts(
    results: Sequence[TripResult], models: Sequence[Model], level: float
) -> list[TripResult]:
    """Return results in which a trip also names what it shows with those before it.

    It does where it names no part by itself: with those of the same commissioning, up to ``N_LAST``
    trips together, one more at a time, name the parts that all of them have on the same side of
    healthy. `results` are by mileage; `level` is that of their intervals.
    """
    bogies = {since_km(model): model.bogie for model in models if isinstance(model, BogieModel)}
    joined: list[TripResult] = []
    before: dict[float, list[TripResult]] = {}
    for result in results:
        bogie = bogies.get(result.healthy_since_km)
        is_read = result.status == OK and set(BOGIE_PARTS) <= set(result.estimates)
        if bogie is None or not is_read:
            joined.append(result)
            continue
        last = before.setdefault(result.healthy_since_km, [])
        last[:] = [*last[1 - N_LAST :], result]
        joined.append(result)
        if any(kind_is(part, WORN) for part in parts_of(result.worn)):
            continue
        logs = np.log([[one.estimates[name] for name in BOGIE_PARTS] for one in last])
        widths = np.array([[one.half_widths[name] for name in BOGIE_PARTS] for one in last])
        for n in range(2, len(last) + 1):
            worn = worn_parts(joint_estimate(bogie, logs[-n:], widths[-n:], level))
            same_side = np.abs(np.sign(logs[-n:]).sum(axis=0)) == n
            is_lasting = dict(zip(BOGIE_PARTS, same_side, strict=True))
            if named := [part for part in worn if part.is_named and is_lasting[part.names[0]]]:
                worn_words = together(_of_trips(part.finding, n) for part in named)
                joined[-1] = replace(result, worn=worn_words)
                break
    return joined


def _of_trips(finding: Finding, n: int) -> Finding:
    """Return a finding whose odds say of how many trips they are."""
    odds = Finding("odds-of-trips", odds=finding.values["odds"], n=n)
    return Finding(WORN, **{**finding.values, "odds": odds})
