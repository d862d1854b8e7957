"""Sentences that other packages compose in English, and how pages say them in another language.

A reason such as "the last trip is at 62.1 % of healthy, below the act limit of 70 %" is data: it is
stored, logged and written to tables in English. ``spoken`` finds the pattern that it was composed
by, and fills in the pattern's translation.
"""

from __future__ import annotations

import functools
import re

from suspnet.report.language import ENGLISH, N_, current, decimal, gettext

PATTERNS = (
    # Names of parameters, parts and places.
    N_("stiffness of the primary spring"),
    N_("damping of the primary damper"),
    N_("stiffness of the secondary spring"),
    N_("damping of the secondary damper"),
    N_("mass of the car body"),
    N_("damper of {where}"),
    N_("spring of {where}"),
    N_("secondary damper, {side}"),
    N_("secondary spring, {side}"),
    N_("all twelve parts"),
    N_("axle {n}"),
    N_("axle {n}, {side}"),
    N_("left"),
    N_("right"),
    N_("leading"),
    N_("trailing"),
    N_("leading bogie"),
    N_("trailing bogie"),
    N_("lead. left"),
    N_("lead. right"),
    N_("trail. left"),
    N_("trail. right"),
    N_("lead."),
    N_("trail."),
    N_("train {name}"),
    N_("car {name}"),
    N_("sensor {name}"),
    N_("sensor {name}: {words}"),
    N_("sensor"),
    N_("unknown"),
    N_("primary suspension: axle box to bogie frame"),
    N_("secondary suspension: frame to car body"),
    # Causes, states and work.
    N_("limit"),
    N_("change"),
    N_("sister"),
    N_("act"),
    N_("notice"),
    N_("none"),
    N_("ok"),
    N_("no estimate"),
    N_("error"),
    N_("replace"),
    N_("inspect"),
    N_("plan again"),
    N_("{what} at the visit of {day}"),
    N_("as in its first trips"),
    N_("too few trips to compare"),
    N_("Files read as"),
    N_("All"),
    N_("Last {km} km"),
    N_("Last 20 trips"),
    # Level of the last trips.
    N_("no trip with an estimate"),
    N_("at {value} %"),
    N_("at over {value} %"),
    N_("at {value} % of healthy"),
    N_("above the act limit of {limit} %"),
    N_("below the act limit of {limit} %"),
    N_("above the notice limit of {limit} %"),
    N_("below the notice limit of {limit} %"),
    N_("the last trip is {level} of healthy, {beyond}"),
    N_("the last {n} trips are {level} of healthy, {beyond}"),
    N_("{k} of the last {n} trips are {level} of healthy, {beyond}"),
    N_("was {level} of healthy, {beyond}, at {km} km"),
    N_("the last trip is {level}"),
    N_("{words}, but it is flagged and may be wrong"),
    N_("{words}, but they are flagged and may be wrong"),
    N_("{words}, but without an interval that would make it sure"),
    N_("{words}, but its interval reaches back within it: too uncertain to judge"),
    N_("{words}, but their intervals reach back within it: too uncertain to judge"),
    N_("{words} (alarm since {km} km)"),
    N_("within its limits"),
    N_("{words}, within its limits"),
    N_("{k} of the last {n} trips lies beyond a limit, the newest not"),
    N_("{k} of the last {n} trips lie beyond a limit, the newest not"),
    # Development along the mileage.
    N_("the change began at about {km} km"),
    N_("earlier, it differed by {size} % before and after about {km} km"),
    N_("it has been so since the first trips"),
    N_("too few trips so far to call it a lasting change"),
    N_("not clear against the spread of {size} %"),
    N_("not judged, as {words}"),
    N_("all trips are flagged"),
    N_("all of the last {n} trips are flagged"),
    N_("the only trip is flagged"),
    N_("{words} (payload: varies by nature, no fault)"),
    N_("{words}, without the flagged trips"),
    N_("too few trips ({k} of {n}) to find a change"),
    N_("too few trips ({k} of {n})"),
    N_("too few trips ({k} of {n} without a flag)"),
    N_("too few trips with a mileage and an estimate that is certain enough"),
    N_("no change beyond the spread of {size} %"),
    N_("differs by {size} % before and after about {km} km, but ends as it began"),
    N_("falls by {size} %"),
    N_("rises by {size} %"),
    N_("falls to {value} % of healthy (median of the last {n} trips)"),
    N_("rises to {value} % of healthy (median of the last {n} trips)"),
    N_("{words}, steadily along the mileage"),
    N_("{words} from the first to the last trips"),
    N_("{words}, gradually around {km} km, and was still falling at the end"),
    N_("{words}, gradually around {km} km, and was still rising at the end"),
    N_("{words} at about {km} km"),
    N_("{k} of the first {n} trips is flagged"),
    N_("{k} of the first {n} trips are flagged"),
    N_("{k} of the last {n} trips is flagged"),
    N_("{k} of the last {n} trips are flagged"),
    N_("{k} of the first {n} and {j} of the last {m} trips are flagged"),
    # Alarms of changes, sisters and sensors.
    N_("fell by {size} % at about {km} km"),
    N_("rose by {size} % at about {km} km"),
    N_("{words}, by {size} % on the last {n} trips"),
    N_(
        "{part} is {size} % below that of its one sister ({own} and {other} % of "
        "healthy): which of them changed is not known"
    ),
    N_(
        "{part} is {size} % above that of its one sister ({own} and {other} % of "
        "healthy): which of them changed is not known"
    ),
    N_(
        "{part} is {size} % below {k} of its {n} sisters ({own} and {other} % of "
        "healthy): which of them changed is not known"
    ),
    N_(
        "{part} is {size} % above {k} of its {n} sisters ({own} and {other} % of "
        "healthy): which of them changed is not known"
    ),
    N_("{part} is {size} % below its sisters (median of {n})"),
    N_("{part} is {size} % above its sisters (median of {n})"),
    N_("noise {factor} times as in its first trips"),
    N_("sensitivity {size} % since its first trips"),
    N_("{size} ms late since its first trips"),
    N_("drop-outs in {size} % of the trip"),
    N_("sensitivity {size} % against {name} since the first trips: one of the two"),
    N_("alarms of changes not armed yet: {words}"),
    # Sentences on a suspension or a fleet.
    N_("Act: {k} of {n} parameters is beyond the act limit:"),
    N_("Act: {k} of {n} parameters are beyond the act limit:"),
    N_("Act: {k} of {n} parameters is beyond the act limit, {m} more to be looked at:"),
    N_("Act: {k} of {n} parameters are beyond the act limit, {m} more to be looked at:"),
    N_("Notice: {k} of {n} parameters is to be looked at:"),
    N_("Notice: {k} of {n} parameters are to be looked at:"),
    N_("No trip has an estimate, so that nothing is known."),
    N_("No alarm, but {k} of {n} parameters cannot be judged:"),
    N_("No parameter is beyond its limits"),
    N_("No parameter has limits"),
    N_("{words}; {k} of {n} parameters changed:"),
    N_("{words}; there are too few trips to find a change."),
    N_("{words}; some parameters have too few trips to find a change."),
    N_("Nothing stands out. {words}, and none changed by more than its trips scatter."),
    N_("{n} suspension: {words}."),
    N_("{n} suspensions: {words}."),
    N_("{n} to act on"),
    N_("{n} to be looked at"),
    N_("{n} not judged"),
    N_("{n} without alarm"),
    N_("No single spring or damper is named: {words}."),
    N_("No single spring or damper is named on {n} trips: {words}."),
    N_("No single spring or damper is named on {n} trip: {words}."),
    N_(
        "these estimates take both sides and both axles as equal, protocol=components "
        "with sensors left and right reads each part"
    ),
    N_("worn, odds {odds}"),
    N_("over {n} : 1"),
    N_("one of group {letter}"),
    N_("one of several has worn{common} (odds {odds}), which is not known: {parts}"),
    N_(" on the left"),
    N_(" on the right"),
    N_(" at axle {n}"),
    N_(" at axle {n} on the {side}"),
    N_("{part} or {parts}"),
    N_("{words} at {km} km"),
    N_("remaining life: {words}"),
    # Remarks of a report.
    N_("{k} of {n} trips is flagged, see the table"),
    N_("{k} of {n} trip is flagged, see the table"),
    N_("{k} of {n} trips are flagged, see the table"),
    N_("All {n} trips are flagged, and none of these numbers is to be relied on: {words}"),
    N_("{k} of them: {words}"),
    N_("Worn parts on {trips}"),
    N_("{k} of the last {n} trips"),
    N_("the last trip"),
    N_("Left and right differ on {trips}"),
    N_("An estimate is the mean of both sides."),
    N_(
        "Sensors of a pair that differ in place or sensitivity, and a track with "
        "one rail worse than the other, can look alike: compare several trips."
    ),
    N_("axle box"),
    N_("bogie frame"),
    N_("car body"),
    N_("primary suspension"),
    N_("secondary suspension"),
    N_("{name} at about {value} % lies outside the {low} to {high} % trained for"),
    # The plan.
    N_("{unknown}{visits} with {jobs} until {day}, {waiting}, {quiet}."),
    N_("{n} part unknown, "),
    N_("{n} parts unknown, "),
    N_("{n} visit"),
    N_("{n} visits"),
    N_("{n} job"),
    N_("{n} jobs"),
    N_("{n} part waits"),
    N_("{n} parts wait"),
    N_("{n} needs nothing"),
    N_("{n} need nothing"),
    N_("No plan costs less."),
    N_("The search was ended: the best plan may cost up to {size} % less."),
    N_("{names}: {km} km a day are assumed, as the dates of the trips are unknown or too close."),
    N_("{names} and {n} more"),
    # Figures and the state of the page.
    N_("last read at {time}"),
    N_("reading changes, since {time}"),
    N_("not read yet"),
    N_("The store cannot be read: {words}."),
    N_("The state of the fleet could not be computed: {words}."),
    N_("The history is no longer read: start suspnet-serve again."),
    N_("The history is no longer read ({words}): start suspnet-serve again."),
    N_("flagged: see the table"),
    N_("trip"),
    N_("trip without an estimate"),
    N_("median of five neighbouring trips"),
    N_("act limit will be passed (80 %)"),
    N_("passes the act limit at about {km} km (80 %: {low} to {high})"),
    N_("no end"),
    N_("{low} to {high}"),
    N_("maintenance"),
    N_("commissioned again"),
    N_("{severity}: start of an alarm"),
    N_("over {value} %"),
    N_("{symbol} [% of healthy]"),
    N_("% of healthy"),
    N_("{symbol} [% of nominal]"),
    N_("without a mileage, not shown: {n}"),
    N_("its {value} % interval"),
    N_("truth (simulated)"),
    N_("act limit"),
    N_("notice limit"),
    N_("beyond the axis"),
    N_("commissioned again; % is of the first healthy values"),
    N_("mileage [1000 km]"),
    N_("mileage [km]"),
    N_("frequency [Hz]"),
    N_("nothing to be done"),
    N_("day of the visit"),
    N_("train"),
    N_("Plan of {today}: {visits}, {jobs} until {day}"),
    N_("{n} part unknown"),
    N_("{n} parts unknown"),
    N_("{k} trains of {n}, the most urgent"),
    N_("remaining life unknown"),
    N_("visit on the first possible day"),
    N_("visit to be decided on within a month"),
    N_("later visit"),
    N_("limit passed: {value} % interval"),
    N_("least to largest value"),
    N_("mean"),
    N_("not usable"),
    N_("trip at {km} km"),
    N_("time [min]"),
    N_("time [s]"),
    N_("speed\n[km/h]"),
    N_("95 % band of the last trip"),
    N_("magnitude"),
    N_("coherence"),
    N_("independent\naverages"),
    N_("mean\ncoherence"),
    N_("usable share\n[%]"),
)
"""Patterns of sentences; what is in braces varies, and is translated in the same way."""
SEPARATORS = ("\n", "; ", ". ", ", ", ": ")
"""What joins sentences and places, tried in this order where no pattern has the whole text."""
LONGEST = 800
"""Length of a text above which it is not translated: its patterns would take too long."""


def spoken(text: str) -> str:
    """Return a composed English text in the current language; what has no pattern stays as it is.

    Examples
    --------
    >>> from suspnet.report.language import speaking
    >>> with speaking("de"):
    ...     spoken("the last trip is at 62.1 % of healthy, below the act limit of 70 %")
    'die letzte Fahrt liegt bei 62,1 % des Referenzwerts, unter der Eingriffsgrenze von 70 %'
    """
    if current() == ENGLISH or len(text) > LONGEST:
        return text
    return _spoken(text, current())


@functools.lru_cache(maxsize=10_000)
def _spoken(text: str, language: str) -> str:
    """Return a text in a language, which is the current one: it is an argument for the cache."""
    if re.fullmatch(r"[-+\N{MINUS SIGN}]?[\d \N{NO-BREAK SPACE}]*\.?\d+%?", text):
        return decimal(text)
    if text in _WHOLE:
        return gettext(text)
    for pattern, expression in _expressions():
        if found := expression.fullmatch(text):
            values = {name: _spoken(value, language) for name, value in found.groupdict().items()}
            return gettext(pattern).format(**values)
    for separator in SEPARATORS:
        if separator in text:
            end = "." * (separator == ". ")  # a sentence is known with its full stop
            *parts, last = text.split(separator)
            said = [_spoken(one + end, language).removesuffix(end) for one in parts]
            return separator.join([*said, _spoken(last, language)])
    return f"{_spoken(text[:-1], language)}." if text.endswith(".") else text


_WHOLE = frozenset(one for one in PATTERNS if "{" not in one)


@functools.cache
def _expressions() -> list[tuple[str, re.Pattern[str]]]:
    """Return the patterns with variable parts as regular expressions, the longest first."""
    found = []
    for pattern in PATTERNS:
        parts = re.split(r"\{(\w+)\}", pattern)
        if len(parts) > 1:
            source = "".join(
                _group(part) if i % 2 else re.escape(part) for i, part in enumerate(parts)
            )
            found.append((sum(map(len, parts[::2])), pattern, re.compile(source)))
    found.sort(key=lambda one: -one[0])
    return [(pattern, expression) for _, pattern, expression in found]


NUMBERS = frozenset({"k", "n", "j", "m", "size", "value", "limit", "km", "factor", "own", "other"})
"""Variable parts that are numbers: no other text matches them."""


def _group(name: str) -> str:
    if name in ("visits", "jobs", "waiting", "quiet"):
        return rf"(?P<{name}>\d+ [\w ]+)"
    if name in ("day", "today"):
        return rf"(?P<{name}>\d+-\d+-\d+)"
    if name in ("low", "high"):
        return rf"(?P<{name}>[\d \N{{NO-BREAK SPACE}}.-]+|no end)"
    if name in NUMBERS:
        return rf"(?P<{name}>[-+]?[\d \N{{NO-BREAK SPACE}}.,e]*\d|inf|nan)"
    return rf"(?P<{name}>{'.*?' if name in ('unknown', 'common') else '.+?'})"
