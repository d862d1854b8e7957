"""The pages: the fleet, one suspension with its figures and forms, the plan."""

from __future__ import annotations

import hashlib
import threading
import unicodedata
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from typing import Any, NamedTuple

import flask
import numpy as np
from flask.typing import ResponseReturnValue
from flask_wtf import FlaskForm
from wtforms import HiddenField, StringField
from wtforms.validators import DataRequired, Length, ValidationError

from suspnet.depot.web.access import MAX_NAME, identify_visitor, visitor
from suspnet.depot.web.service import current_refresher, named_state, opened_store, stored_trips
from suspnet.ground.findings import of
from suspnet.ground.parameters import BODY_MASS, BOGIE_PARTS, NAMES, PARAMETERS, Severity
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.wording import natural
from suspnet.runs.language import N_, current, gettext, spoken
from suspnet.trains.history import HistoryError
from suspnet.trains.history.store import acknowledge_alarms
from suspnet.trains.maintenance.alarms import Alarm, newest_of
from suspnet.trains.maintenance.plan import joined, place_of
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.bogie import bogie_of, bogies_shown, small_figures, visits_of
from suspnet.trains.pages.overview import FleetView, finding, overview_row
from suspnet.trains.pages.tables import files_read_as, sensor_rows, trip_table
from suspnet.trains.pages.templates import MARKS

MAX_ROWS = 50  # largest number of rows of a table of the fleet; fewer are chosen by train and state
N_TRIPS = 20  # number of the newest trips in the table of a suspension
OUTPUTS = tuple(name for name in PARAMETERS if name != BODY_MASS)
SHORT = {"leading": "lead.", "trailing": "trail."}  # short words of a place, for a tile

pages = flask.Blueprint("pages", __name__)
pages.before_request(identify_visitor)
_drawing = threading.Lock()


class Choice(NamedTuple):
    """Which suspensions are shown; an empty `train` or `severity` chooses all."""

    train: str = ""
    severity: str = ""

    def holds(self, state: State) -> bool:
        """Return whether a suspension is chosen."""
        is_of_train = self.train in ("", state.place.train)
        return is_of_train and self.severity in ("", str(state.severity))


@pages.get("/")
def fleet() -> ResponseReturnValue:
    """Return the page of the fleet."""
    view, choice = _view(), _choice()
    chosen = [i for i, state in enumerate(view.states) if choice.holds(state)]
    alarms = _active_alarms(view, chosen)
    of_train = Choice(choice.train)
    severities = [state.severity for state in view.states if of_train.holds(state)]
    entries = view.entries
    page = _page(
        "fleet_page.html",
        _digest(view.at, view.version),
        finding=finding([view.rows[i] for i in chosen]),
        choice=choice,
        counts={str(level): severities.count(level) for level in sorted(Severity, reverse=True)},
        trains=_tiles_of_trains(view, chosen),
        alarms=alarms[:MAX_ROWS],
        n_alarms=len(alarms),
        rows=[view.rows[i] | {"address": _address(view.names[i])} for i in chosen[:MAX_ROWS]],
        n_rows=len(chosen),
        parameters=OUTPUTS,
        plan=view.plan,
        address=_address,
        **bogies_shown([entries[i] for i in chosen], view.plan),
    )
    return page, 503 if view.trouble and not view.states else 200


@pages.get("/plan")
def plan() -> ResponseReturnValue:
    """Return the page of the plan."""
    view, choice = _view(), _choice()
    names = {
        place_of(state): name
        for name, state in zip(view.names, view.states, strict=True)
        if choice.holds(state)
    }
    jobs = [
        job | {"address": _address(names[place])}
        for job in joined(view.plan.rows() if view.plan else [])
        if (place := (job["train"], job["car"], job["suspension"])) in names
    ]
    version = _digest(view.at, view.version)
    return _page("plan_page.html", version, plan=view.plan, choice=choice, jobs=jobs)


@pages.get("/plan/calendar.svg")
def calendar() -> ResponseReturnValue:
    """Return the calendar of the plan."""
    plan = _view().plan
    if plan is None:
        flask.abort(404)
    return _svg("calendar", plan)


@pages.get("/suspension/<name>/trend.svg")
def trend(name: str) -> ResponseReturnValue:
    """Return the figure of the parameters along the mileage, or `of` one of them."""
    state, part = named_state(name), flask.request.args.get("of", "")
    if part and part not in _figured(state):
        flask.abort(404)
    return _svg("trend", state, part)


@pages.get("/suspension/<name>/responses.svg")
def responses(name: str) -> ResponseReturnValue:
    """Return the figure of the frequency responses."""
    with opened_store() as store:
        stored = store.responses(*named_state(name).key)
    if not stored:
        flask.abort(404)
    return _svg("responses", stored)


def _svg(figure: str, *values: Any) -> flask.Response:
    """Return a figure; one is drawn at a time, as those that wait may find theirs drawn by then."""
    with _drawing:
        draw = getattr(import_module("suspnet.depot.web.figures"), figure)
        return flask.Response(draw(*values, current()), mimetype="image/svg+xml")


@pages.get("/suspension/<name>")
def suspension(name: str) -> ResponseReturnValue:
    """Return the page of a suspension."""
    form = AcknowledgementForm(formdata=None, by=visitor().name or flask.session.get("by", ""))
    return _suspension_page(name, form)


@pages.post("/suspension/<name>/acknowledge")
def acknowledge(name: str) -> ResponseReturnValue:
    """Store an acknowledgement of an alarm, and return to the page of its suspension."""
    state, form = named_state(name), AcknowledgementForm()
    if not visitor().is_engineer:
        words = gettext("%(name)s may look, but not acknowledge alarms: that is for engineers.")
        flask.abort(403, words % {"name": visitor().name})
    if visitor().name:  # never the name that a form claims
        form.by.data = visitor().name
    if not form.validate_on_submit():
        return _suspension_page(name, form), 400
    chosen = [alarm for alarm in state.alarms if form.means(alarm)]
    if not chosen:
        flask.flash(
            gettext("Nothing was acknowledged: this alarm is cleared, or worse than it was shown.")
        )
        return flask.redirect(_address(name))
    by, action = form.by.data.strip(), (form.words.data or "").strip()
    newest_km = float(np.nanmax(state.series.mileage_km))
    with opened_store(to_write=True) as store:
        acknowledge_alarms(store, *state.key, chosen, newest_km, by, action)
    current_refresher().soon()
    flask.session["by"] = by
    alarms = ", ".join(f"{alarm.parameter} ({gettext(str(alarm.cause))})" for alarm in chosen)
    words = gettext("Acknowledged by %(name)s: %(alarms)s.")
    flask.flash(words % {"name": by, "alarms": alarms})
    return flask.redirect(_address(name))


@pages.get("/state")
def state() -> ResponseReturnValue:
    """Return the version of a page's state and when it was read; cheap, as pages poll it."""
    view, name = _view(), flask.request.args.get("of", "")
    version = _suspension_version(view, name) if name else _digest(view.at, view.version)
    return {"version": version, "words": spoken(current_refresher().words)}


def _suspension_page(name: str, form: AcknowledgementForm) -> str:
    view, state = _view(), named_state(name)
    version = _suspension_version(view, name)
    results, stored, trouble = [], [], ""
    seen, bad_rows = view.acknowledged.get(state.key, ()), []
    try:
        with opened_store() as store:
            bad_rows = store.bad_rows
            results, seen = stored_trips(store, state), store.acknowledgements(*state.key)
            stored = store.responses(*state.key)  # last: damaged curves must not hide the trips
    except HistoryError as error:
        trouble = str(error)
    bad_rows = [*(row for row in view.bad_rows if row.key == state.key), *bad_rows]
    cleared = [alarm for alarm in reversed(state.watched.alarms) if not alarm.is_open]
    newest = list(reversed(results[-N_TRIPS:]))
    mileages = state.series.mileage_km[np.isfinite(state.series.mileage_km)]
    # a figure of each part where parts are read; else of those with a finding, and one of all
    figure = partial(flask.url_for, "pages.trend", name=name, version=version, language=current())
    return _page(
        "suspension_page.html",
        "" if form.errors else version,  # a filled form is never replaced
        of=name,
        name=name,
        form=form,
        visitor=visitor(),
        trouble=trouble,
        bad_rows=list(dict.fromkeys(bad_rows)),
        state=state,
        parameters=[name for name in state.outputs if name != BODY_MASS],
        row=overview_row(state, view.acknowledged),
        bogie=bogie_of(state, view.plan),
        small=small_figures(state, {part: figure(of=part) for part in _figured(state)}),
        trend=figure(),
        names=NAMES,
        alarms=[(alarm, newest_of(alarm, seen)) for alarm in state.alarms],
        cleared=[(alarm, newest_of(alarm, seen)) for alarm in cleared],
        trips=trip_table(newest, state.outputs, INTERVAL_LEVEL),
        read_as=files_read_as(newest),
        first_km=float(mileages.min()) if len(mileages) else np.nan,
        newest_km=float(mileages.max()) if len(mileages) else np.nan,
        sensors=sensor_rows(state.series),
        responses=bool(stored),
    )


def _page(template: str, version: str, of: str = "", **values: Any) -> str:
    """Return a page; the browser replaces it when `version` changes, never if it is empty."""
    view = _view()
    trains = sorted({state.place.train for state in view.states} - {""}, key=natural)
    values |= {"view": view, "refresher": current_refresher(), "train_names": trains}
    return flask.render_template(template, version=version, of=of, **values)


def message_page(title: str, words: str) -> str:
    """Return a page with a message alone."""
    return _page("message_page.html", "", title=title, words=words)


def _view() -> FleetView:
    return current_refresher().board.view


def _figured(state: State) -> list[str]:
    """Return the parameters with a figure of their own: those of ``small_trends``."""
    names = [name for name in state.outputs if name != BODY_MASS]
    has_parts = bool(set(names) & set(BOGIE_PARTS))
    return [name for name in names if has_parts or state.severities[name] > Severity.NONE]


def _choice() -> Choice:
    """Return which suspensions the URL asks for; unknown values choose all."""
    severity = flask.request.args.get("severity", "")
    return Choice(flask.request.args.get("train", ""), severity if severity in MARKS else "")


def _address(name: str) -> str:
    return flask.url_for("pages.suspension", name=name)


def _active_alarms(view: FleetView, chosen: Sequence[int]) -> list[dict[str, Any]]:
    """Return the active alarms, the worst first, those not yet acknowledged before others."""
    alarms = [
        {
            "name": view.names[i],
            "state": view.states[i],
            "alarm": alarm,
            "seen": newest_of(alarm, view.acknowledged.get(view.states[i].key, ())),
        }
        for i in chosen
        for alarm in view.states[i].alarms
    ]
    return sorted(alarms, key=lambda row: (-row["alarm"].severity, row["seen"] is not None))


def _tiles_of_trains(
    view: FleetView, chosen: Sequence[int]
) -> dict[str, dict[str, list[dict[str, str]]]]:
    """Return the tiles of the chosen suspensions by train and car, in natural order of names.

    A tile has the name in URLs, the severity, a short text and the reason.
    """

    def order(index: int) -> tuple[Any, ...]:
        vehicle, place = view.states[index].key
        texts = (place.train, place.car, place.suspension, place.bogie, place.side)
        return (*map(natural, texts), vehicle)

    is_named = len({state.place.suspension for state in view.states}) > 1
    trains: dict[str, dict[str, list[dict[str, str]]]] = {}
    for index in sorted(chosen, key=order):
        (vehicle, place), row = view.states[index].key, view.rows[index]
        texts = [place.suspension] if is_named or not (place.bogie or place.side) else []
        where = " ".join(SHORT.get(text, text) for text in (place.bogie, place.side) if text)
        words = " ".join(filter(None, (*texts, spoken(where)))) or vehicle
        reason = of(row["parameter"], row["reason"]) if row["parameter"] else row["reason"]
        tile = {"name": view.names[index], "severity": row["severity"]}
        tiles = trains.setdefault(place.train, {}).setdefault(place.car, [])
        tiles.append(tile | {"words": words, "reason": reason})
    return trains


def _suspension_version(view: FleetView, name: str) -> str:
    if name not in view.keys:
        return _digest("gone")
    state, row = view.states[view.keys[name]], view.rows[view.keys[name]]
    return _digest(
        {key: value for key, value in row.items() if "life" not in key},
        (state.alarms, state.series.events, sorted(state.lives), state.newest_trips[1].tolist()),
        view.acknowledged.get(state.key, ()),
        visits_of(view.plan, state),
        view.is_complete,
    )


def _digest(*values: Any) -> str:
    values = (*values, current_refresher().fault)
    return hashlib.sha256(repr(values).encode()).hexdigest()[:16]


def _check_plain(form: FlaskForm, field: StringField) -> None:
    # categories C of Unicode: control characters, marks of direction, surrogates, unassigned ones
    if any(unicodedata.category(character)[0] == "C" for character in field.data or ""):
        raise ValidationError(N_("Leave out control characters."))


class AcknowledgementForm(FlaskForm):  # type: ignore[misc]
    """Form of an acknowledgement: name, text, and the alarm as the page showed it."""

    by = StringField(
        N_("Your name"), [DataRequired(N_("Enter your name.")), Length(max=MAX_NAME), _check_plain]
    )
    words = StringField(N_("Action taken"), [Length(max=500), _check_plain])
    parameter, cause, severity = HiddenField(), HiddenField(), HiddenField()

    def means(self, alarm: Alarm) -> bool:
        """Return whether an alarm is the one of this form, and no worse than shown."""
        same = (alarm.parameter, str(alarm.cause)) == (self.parameter.data, self.cause.data)
        severities = {str(severity): severity for severity in Severity}
        return same and alarm.severity <= severities.get(self.severity.data or "", -1)
