"""Dead and failing sensors of a suspension, from its trips."""

from collections.abc import Collection, Iterable, Sequence

from suspnet.ground.findings import OF, WITHOUT_SENSORS, Finding, at, kind_is, parts_of, together
from suspnet.ground.parameters import Cause
from suspnet.ground.records import TripResult, sensors_from_text
from suspnet.trains.maintenance.series import N_LAST
from suspnet.trains.maintenance.state import State

LISTED = 5  # trips that are listed for a failing sensor
DEAD = "dead-left-out", "dead-read-alone"  # kinds of the faults of a sensor that shows nothing
FAILING = *DEAD, "loose", "loose-of-pair"


def _failing(result: TripResult, kinds: Collection[str] = FAILING) -> dict[str, Finding]:
    """Return the faults of some kinds of a trip, by the name of the sensor."""
    faults = (fault for fault in parts_of(result.quality.faults) if kind_is(fault, OF))
    return {
        fault.values["name"]: fault
        for fault in faults
        if getattr(fault.values["words"], "kind", "") in kinds
    }


def failing_sensors(results: Sequence[TripResult]) -> dict[str, list[str]]:
    """Return what is known of each sensor that is dead, loose or left out of a trip's parts.

    With it are the names of its trips.
    """
    trips: dict[str, list[str]] = {}
    for result in results:
        failing = _failing(result)
        # a sensor whose faults would break a trip up is left out of its parts alone
        left_out = {
            name: at(name, "not-used-for-parts")
            for warning in parts_of(result.quality.warnings)
            if kind_is(warning, WITHOUT_SENSORS)
            for name in warning.values["names"]
        }
        for words in (left_out | failing).values():
            trips.setdefault(words, []).append(result.trip)
    return trips


def dead_words(results: Sequence[TripResult]) -> str:
    """Return the sensors that are dead on the newest trip that has any, as text; empty if none.

    `results` are in the order of the mileage. A sensor that was replaced since is not named.
    """
    newest = [result for result in results if result.quality.faults or result.estimates][-1:]
    names = [name for result in newest for name in _failing(result, DEAD)]
    n_dead = sum(bool(_failing(result, DEAD)) for result in results)
    return _left_out(names, n_dead, len(results))


def failing_words(results: Sequence[TripResult]) -> str:
    """Return ``dead_words``, or the sensors that failed on one of the last trips, as text."""
    if words := dead_words(results):
        return words
    last = results[-N_LAST:]
    failing = [words for words in failing_sensors(last) if isinstance(words, Finding)]
    names = dict.fromkeys(finding.values["name"] for finding in failing)
    n = sum(bool(failing_sensors([result])) for result in last)
    kind = "dead-or-loose-on" if len(last) > 1 else "dead-or-loose"
    return Finding(kind, names=_listed(names), n=n, n_last=len(last)) if n else ""


def sensor_words(state: State) -> str:
    """Return the dead sensors of a stored suspension and those with an alarm; empty if none.

    A sensor without a usable sample on the newest trip, by its share of drop-outs, is dead.
    """
    texts = [*filter(None, state.series.sensors.tolist())]
    dead = [] if not texts else _dead_in(texts[-1])
    n_dead = sum(bool(_dead_in(text)) for text in texts) if dead else 0
    alarms = [
        alarm.words
        for alarm in state.alarms
        if alarm.cause == Cause.SENSOR and alarm.parameter not in dead
    ]
    return together([_left_out(dead, n_dead, len(texts)), *alarms])


def _dead_in(text: str) -> list[str]:
    """Return the dead sensors of a trip from ``Quality.sensors``."""
    return [name for name, health in sensors_from_text(text).items() if health.faulty >= 1]


def _left_out(names: Sequence[str], n_dead: int, n_trips: int) -> str:
    """Return the names of dead sensors as text, with the number of trips that have any."""
    if not names:
        return ""
    trips = Finding("trips", n=n_trips)
    return Finding("dead-on-trips", names=_listed(names), n=n_dead, trips=trips)


def _listed(names: Iterable[str]) -> str:
    return together((Finding("sensor-name", name=name) for name in names), ", ")
