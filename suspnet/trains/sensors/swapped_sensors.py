"""Places that manifests confuse: two sensors with each other, bogies and axles with others.

For each two sensors, the residuals of `trains.spectra.subspace` at the median vehicle are computed
with them exchanged, model errors allowed for. Where an exchange lowers their rms,
or nearly does, the trip is fitted with the sensors as given and exchanged, and the misfits decide.

Left and right have their place in the residuals by the roll that they show. The rms alone finds
most exchanges. Of two sensors that move almost alike it may hardly change: then the fit decides.

Bogie and axle are found likewise, from one trip whose direction is known: where the drawing's
vehicle has smaller or nearly the same residuals as measured elsewhere, the trip is fitted with
those places. Another place may have the smaller residuals at the median vehicle, so the residuals
only choose which places are fitted. Healthy trips that the vehicle does not explain are looked at
in the same way. The evidence is in docs/methods.md; benchmarks/swapped_sensors.py repeats it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from operator import attrgetter, itemgetter
from typing import Literal, TypeVar

from suspnet.curves.estimates import EstimateSettings
from suspnet.ground.findings import Finding, at, of, together
from suspnet.ground.parameters import DIRECTIONS, REVERSE, Direction
from suspnet.trains.fits.bogie_fit import healthy_misfit
from suspnet.trains.fits.bogie_misfit import BogieMisfit
from suspnet.trains.fits.bogie_search import end_near, learnt_end, misfits_in
from suspnet.trains.fits.healthy_misfit import HealthyMisfit, HealthySpectra
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.spectra.bogie_trip import BogieTrip, smallest_noise
from suspnet.vehicle import SpatialVehicle, VerticalVehicle
from suspnet.vehicle.vertical_vehicle import OTHER_END

Item = TypeVar("Item")
CLEARER = 1.25  # factor by which the misfit must fall for two sensors to be called swapped
EXPLAINS = 2.0
"""Misfit below which an exchange explains a trip. With the wrong bogie given an exchange may lower
the misfit, too, but explains nothing."""
ALIKE = 1.02
"""Rms residual as given, over that exchanged, up to which only an exchange that explains the trip
counts: without the flexible modes of its train it fell by 0.6 % (flexible_train, seed 3)."""
OTHER_BOGIE = 2.0  # factor by which the misfit must fall for another bogie or axle to be reported
NEARLY = 1.2
"""Largest rms residual at the median vehicle, over the smallest of all bogies, axles or orders of
sensors, with which one is fitted. It allows for a worn vehicle, whose own place may not have the
smallest residual."""

OTHER_PLACE: dict[Literal["axle", "centre"], Literal["axle", "centre"]] = {
    "axle": "centre",
    "centre": "axle",
}
ROUGHLY = 0.5
"""Rms residual of `place_fits` up to which sensors at some place explain a trip: rigid vehicles had
up to 0.2 in their own place, and a bogie frame stiffened by its axle guidance 0.9 in the other."""


@dataclass(frozen=True)
class PlaceFit:
    """A trip's fit with its sensors at one place: the vehicle measured there.

    `score` is the rms residual with model errors of 30 % and the priors, `misfit` that over noise.
    """

    vehicle: VerticalVehicle
    score: float
    misfit: float


@dataclass(frozen=True)
class Elsewhere:
    """Another place of the sensors than the stated one, which explains a trip where that does not.

    The place is that of the frame's sensor, the measured axle, and the direction of travel.
    """

    stated: PlaceFit
    best: PlaceFit

    @property
    def change(self) -> tuple[str, str, Direction]:
        """The better place, with axle and direction."""
        return place_of(self.best.vehicle)

    def __str__(self) -> str:
        was, now = self.stated.vehicle, self.best.vehicle
        looks, say = [], []
        if now.frame_sensor != was.frame_sensor:
            is_centre = now.frame_sensor == "centre"
            looks.append(Finding("frame-at-centre" if is_centre else "frame-above-axle"))
            say.append(Finding("say-frame-centre" if is_centre else "say-frame-axle"))
        if now.axle != was.axle:
            looks.append(Finding("sensors-at-other-axle", axle=now.axle))
            say.append(Finding("correct-axle"))
        if now.direction != was.direction:
            is_back = now.direction == REVERSE
            looks.append(Finding("runs-in-reverse" if is_back else "runs-forward"))
            say.append(Finding("correct-direction"))
        return at(
            together(looks),
            "misfit-elsewhere",
            misfit=self.best.misfit,
            misfit2=self.stated.misfit,
            say=together(say, "; "),
        )


def place_of(vehicle: VerticalVehicle) -> tuple[str, str, Direction]:
    """Return the place of the frame's sensor, the measured axle and the direction of travel."""
    return vehicle.frame_sensor, vehicle.axle, vehicle.direction


def elsewhere(
    generator: VerticalVehicle,
    settings: EstimateSettings,
    trip: HealthySpectra,
    direction: Direction | None,
) -> Elsewhere | None:
    """Return where a trip's sensors are if not where the vehicle has them; None if they may be.

    Place of the frame's sensor, axle and direction of travel are judged together: one that is wrong
    looks like another one. `direction` is that of the manifest, None if it says none. `settings`
    are bound to the vehicle, the spectra on their bins.
    """
    directions = DIRECTIONS if direction is None else (direction,)
    as_stated = [generator.running(way) for way in directions]
    stated = min(
        (_place_fit(vehicle, settings, trip) for vehicle in as_stated), key=attrgetter("score")
    )
    if stated.score <= ROUGHLY:
        return None
    places = product(OTHER_PLACE, OTHER_END, DIRECTIONS)
    every = [replace(generator, frame_sensor=f, axle=a, direction=way) for f, a, way in places]
    # most trips are nearest to their own place at the median vehicle already
    targets = [_place_misfit(vehicle, settings, trip) for vehicle in every]
    at_start = [target.score(target.start()) for target in targets]
    likely = [vehicle for vehicle in _near(every, at_start, NEARLY) if vehicle not in as_stated]
    fits = [_place_fit(vehicle, settings, trip) for vehicle in likely]
    best = min(fits, key=attrgetter("score"), default=stated)
    if best.score > min(ROUGHLY, stated.score / OTHER_BOGIE):
        return None
    if direction is None:  # either may be: it is no difference
        stated = replace(stated, vehicle=stated.vehicle.running(best.vehicle.direction))
    return Elsewhere(stated, best)


def _place_misfit(
    vehicle: VerticalVehicle, settings: EstimateSettings, trip: HealthySpectra
) -> HealthyMisfit:
    """Return the sum of squares of one trip as a rigid vehicle moves."""
    # with axle guidance a frame may be as good as rigid, and its sensor be anywhere
    rigid = replace(vehicle, parts=(), distribution=None, nominal=None).with_prior()
    return HealthyMisfit(rigid, settings, replace(trip, direction=vehicle.direction))


def _place_fit(
    vehicle: VerticalVehicle, settings: EstimateSettings, trip: HealthySpectra
) -> PlaceFit:
    target = _place_misfit(vehicle, settings, trip)
    end = target.search()
    return PlaceFit(vehicle, target.score(end), target.misfit(end))


def check_order(
    generator: SpatialVehicle,
    trip: BogieTrip,
    where: str = "",
    *,
    nearly: float = 1.0,
    fit: Callable[[], float] | None = None,
) -> None:
    """Raise TripError if two sensors of a trip look swapped.

    `generator` is the vehicle as its drawing or its healthy trips show it, with a distribution; the
    message is of `where`, a file or folder. `nearly` is as for `likely_orders`, each of which takes
    a second. `fit` returns `misfit_near` of the two, where `check_end` may need it as well.
    """
    places = [generator.places[i] for i in trip.kept(generator.places)]
    in_place = list(range(len(places)))
    likely = likely_orders(generator, trip, nearly)
    orders = [order for order in likely if order != in_place]
    if not orders:
        return
    # no order has less than about 1
    if (misfit := fit() if fit else misfit_near(generator, trip)) < CLEARER:
        return
    other, best = min((misfit_near(generator, trip.in_order(order)), order) for order in orders)
    if not other < misfit / CLEARER:
        return
    # at the median vehicle and after the fit, or else the fit explains the trip
    is_clear = best == likely[0] and in_place not in likely_orders(generator, trip, ALIKE)
    if not (is_clear or other < EXPLAINS):
        return
    names = [places[i] for i in in_place if best[i] != i]
    words = Finding("sensors-swapped", names=together(names, " and "), given=misfit, other=other)
    raise TripError(of(where, words) if where else words)


def check_bogie(
    generator: SpatialVehicle, trips: Sequence[BogieTrip], misfit: float, where: str = ""
) -> None:
    """Raise TripError if healthy trips fit another bogie or axle of the vehicle, not their own.

    `misfit` is that of the vehicle that was commissioned on them, `generator` what it started from.
    """
    if misfit < OTHER_BOGIE:
        return
    ends = _likely_ends(_ends(generator)[1:], trips[0])
    fits = [learnt_end(healthy_misfit(end, trips)).bare_misfit for end in ends]
    other, end = min(zip(fits, ends, strict=True), key=itemgetter(0))
    if other < misfit / OTHER_BOGIE:
        words = _other_end("healthy-trips-fit", generator, misfit, end, other)
        raise TripError(of(where, words) if where else words)


def check_end(
    generator: SpatialVehicle, trip: BogieTrip, *, fit: Callable[[], float] | None = None
) -> None:
    """Raise TripError if a trip fits another bogie or axle of the vehicle, and not its own.

    `generator` and `fit` are as for `check_order`; the direction of travel must be known.
    """
    own, *others = _ends(generator)
    ends = [end for end in _likely_ends([own, *others], trip) if end is not own]
    if not ends or (misfit := fit() if fit else misfit_near(own, trip)) < OTHER_BOGIE:
        return
    fits = [misfit_near(end, trip) for end in ends]
    other, end = min(zip(fits, ends, strict=True), key=itemgetter(0))
    if other < misfit / OTHER_BOGIE:
        raise TripError(_other_end("trip-fits", generator, misfit, end, other))


def _ends(generator: SpatialVehicle) -> list[SpatialVehicle]:
    """Return the vehicle as measured at each axle of each bogie, the given one first."""
    return [
        replace(generator, bogie=bogie, axle=axle)
        for bogie in (generator.bogie, OTHER_END[generator.bogie])
        for axle in (generator.axle, OTHER_END[generator.axle])
    ]


def _likely_ends(ends: Sequence[SpatialVehicle], trip: BogieTrip) -> list[SpatialVehicle]:
    """Return those of the ends of a vehicle whose residuals of a trip are nearly the smallest."""
    return _near(ends, [_misfit_at_start(end, trip) for end in ends], NEARLY)


def _near(items: Sequence[Item], misfits: Sequence[float], nearly: float) -> list[Item]:
    """Return the items whose misfit is at most `nearly` times the smallest, which is the first."""
    by_misfit = sorted(zip(misfits, items, strict=True), key=itemgetter(0))
    return [item for misfit, item in by_misfit if misfit <= nearly * by_misfit[0][0]]


def _other_end(
    kind: str, own: SpatialVehicle, misfit: float, end: SpatialVehicle, least: float
) -> Finding:
    keys = [f"`{key}`" for key in ("bogie", "axle") if getattr(own, key) != getattr(end, key)]
    return Finding(
        kind,
        axle=end.axle,
        bogie=end.bogie,
        least=least,
        own_axle=own.axle,
        own_bogie=own.bogie,
        misfit=misfit,
        # with both, it moves like its own end in the other direction
        keys=Finding("bogie-or-direction") if len(keys) > 1 else keys[0],
    )


def _misfit_at_start(generator: SpatialVehicle, trip: BogieTrip) -> float:
    """Return the rms residual of a trip at the median vehicle, as `likely_orders` compares it."""
    fit = _misfit_of(generator, trip)
    return float(misfits_in(fit, [range(len(fit.sensors_of(trip)))])[0])


def likely_orders(generator: SpatialVehicle, trip: BogieTrip, nearly: float) -> list[list[int]]:
    """Return the likely orders of a trip's sensors: as given, or with two of them exchanged.

    Their residuals at the median vehicle are at most `nearly` times the smallest, which is that of
    the first.
    """
    fit = _misfit_of(generator, trip)
    orders = [list(range(len(fit.sensors_of(trip))))]
    for i, j in combinations(orders[0], 2):
        orders.append(list(orders[0]))
        orders[-1][i], orders[-1][j] = j, i
    return _near(orders, misfits_in(fit, orders).tolist(), nearly)


def misfit_near(generator: SpatialVehicle, trip: BogieTrip) -> float:
    """Return the misfit of a trip near the minimum, which is near enough.

    The last search would take ten times as long in another valley.
    """
    return end_near(_misfit_of(generator, trip)).misfit


def _misfit_of(generator: SpatialVehicle, trip: BogieTrip) -> BogieMisfit:
    return BogieMisfit(generator, [smallest_noise(trip.spectra)], [trip], are_healthy=False)
