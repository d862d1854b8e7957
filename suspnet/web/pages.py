"""The pages: the fleet, one suspension with its figures and forms, the plan."""

from __future__ import annotations

import functools
import hashlib
import threading
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any, cast

import numpy as np
from flask import (
    Blueprint,
    Response,
    abort,
    current_app,
    flash,
    redirect,
    render_template,
    request,
    session,
    url_for,
)
from flask.typing import ResponseReturnValue
from flask_wtf import FlaskForm
from wtforms import HiddenField, StringField
from wtforms.validators import DataRequired, Length, ValidationError

from suspnet.ground.parameters import Severity
from suspnet.history import History, HistoryError
from suspnet.history.store import acknowledge_alarms
from suspnet.maintenance.alarms import Acknowledgement, Alarm
from suspnet.maintenance.relative import relative_results
from suspnet.maintenance.schedule import Plan
from suspnet.maintenance.state import State
from suspnet.report.board import Refresher
from suspnet.report.bogie import visits_of
from suspnet.report.language import N_, current, day, gettext, spoken
from suspnet.report.overview import FleetView
from suspnet.report.pdf import as_pdf
from suspnet.report.tables import response
from suspnet.report.templates import MARKS, render
from suspnet.report.trend import trend_of_state
from suspnet.report.work_order import work_orders
from suspnet.web import page_values
from suspnet.web.access import ACCESS, MOST_NAME, Access, identify_visitor, is_plain, visitor
from suspnet.web.figures import response_figure, trend_figure
from suspnet.web.page_values import Choice

READ_S, WRITE_S = 0.5, 2.0
"""Timeouts for reading from a store that is locked by other programs, and for writing to it,
[s]."""
REFRESHER = "suspnet_refresher"
"""Key, among an application's extensions, of the thread that holds the state of the fleet."""
WITH_PLOTS = "suspnet.plots"
"""Key in a request's environment that marks a page with plots."""

HAS_PDF = find_spec("weasyprint") is not None

pages = Blueprint("pages", __name__)
pages.before_request(identify_visitor)
_drawing, _drawing_calendar = threading.Lock(), threading.Lock()


@pages.get("/")
def fleet() -> ResponseReturnValue:
    """Return the page of the fleet."""
    view, choice = current_view(), _choice()
    all_rows = request.args.get("rows") == "all"
    values = page_values.fleet_values(view, choice, all_rows, _address)
    page = _page("fleet_page.html", _fleet_version(view), **values)
    return page, 503 if view.trouble and not view.states else 200


@pages.get("/plan")
def plan() -> ResponseReturnValue:
    """Return the page of the plan."""
    view, choice = current_view(), _choice()
    return _page(
        "plan_page.html",
        _fleet_version(view),
        plan=view.plan,
        choice=choice,
        train_names=page_values.train_names(view),
        jobs=page_values.jobs_of(view, choice, _address),
    )


@pages.get("/plan/calendar.svg")
def calendar() -> ResponseReturnValue:
    """Return the calendar of the plan."""
    found = current_view().plan
    if found is None:
        abort(404)
    with _drawing_calendar:  # around the cache: of those that wait, only the first one draws
        return Response(_calendar(found, current()), mimetype="image/svg+xml")


@pages.get("/suspension/<name>")
def suspension(name: str) -> ResponseReturnValue:
    """Return the page of a suspension."""
    form = AcknowledgementForm(formdata=None, by=visitor().name or session.get("by", ""))
    return _suspension_page(name, form)


@pages.post("/suspension/<name>/acknowledge")
def acknowledge(name: str) -> ResponseReturnValue:
    """Store an acknowledgement of an alarm, and return to the page of its suspension."""
    state, form = _state(name), AcknowledgementForm()
    if not visitor().is_engineer:
        words = gettext("%(name)s may look, but not acknowledge alarms: that is for engineers.")
        abort(403, words % {"name": visitor().name})
    if visitor().name:  # never the name that a form claims
        form.by.data = visitor().name
    if not form.validate_on_submit():
        return _suspension_page(name, form), 400
    chosen = [one for one in state.alarms if form.means(one)]
    if not chosen:
        flash(
            gettext("Nothing was acknowledged: this alarm is cleared, or worse than it was shown.")
        )
        return redirect(_address(name))
    said = form.by.data.strip(), (form.words.data or "").strip()
    store_acknowledgement(state, chosen, *said)
    session["by"] = said[0]
    alarms = ", ".join(f"{a.parameter} ({gettext(str(a.cause))})" for a in chosen)
    words = gettext("Acknowledged by %(name)s: %(alarms)s.")
    flash(words % {"name": said[0], "alarms": alarms})
    return redirect(_address(name))


def store_acknowledgement(
    state: State, alarms: Sequence[Alarm], by: str, words: str
) -> list[Acknowledgement]:
    """Store that a person acknowledges alarms, and return what is stored."""
    vehicle, place = state.key
    newest = float(np.nanmax(state.series.mileage_km))
    with opened(WRITE_S) as store:
        found = acknowledge_alarms(store, vehicle, place, alarms, newest, by, words)
    current_refresher().soon()
    return found


@pages.get("/suspension/<name>/work-order")
def work_order(name: str) -> ResponseReturnValue:
    """Return the work orders of a suspension as a page to print."""
    view, _ = current_view(), _state(name)
    index = view.keys[name]
    return _page(
        "work_order_page.html",
        _suspension_version(view, name),
        of=name,
        name=name,
        row=view.rows[index],
        orders=work_orders(view, index),
        has_pdf=HAS_PDF,
        read_at=_minute(),
    )


@pages.get("/suspension/<name>/work-order.pdf")
def work_order_pdf(name: str) -> ResponseReturnValue:
    """Return the work orders of a suspension as PDF."""
    if not HAS_PDF:
        abort(
            404,
            gettext("Work orders as PDF need WeasyPrint where suspnet-serve runs: the extra pdf."),
        )
    view, _ = current_view(), _state(name)
    index = view.keys[name]
    page = render(
        "work_order_print.html",
        row=view.rows[index],
        orders=work_orders(view, index),
        read_at=_minute(),
    )
    if not _drawing.acquire(blocking=False):  # it takes seconds, and requests must not queue up
        abort(503)
    try:
        return Response(as_pdf(page), mimetype="application/pdf")
    finally:
        _drawing.release()


@pages.get("/suspension/<name>/trend.json")
def trend(name: str) -> ResponseReturnValue:
    """Return the figure of the parameters along the mileage, or `of` one of them."""
    found, of = trend_of_state(_state(name)), request.args.get("of", "")
    if of and of not in [one.name for one in found.panels]:
        abort(404)
    return trend_figure(found, name, of)


@pages.get("/suspension/<name>/responses.json")
def responses(name: str) -> ResponseReturnValue:
    """Return the figure of the frequency responses."""
    with opened() as store:
        stored = store.responses(*_state(name).key)
    if not stored:
        abort(404)
    return response_figure([response(one.trip, one.mileage_km, one) for one in stored], name)


@pages.get("/state")
def state() -> ResponseReturnValue:
    """Return the version of a page's state and when it was read; cheap, as pages poll it."""
    view, name = current_view(), request.args.get("of", "")
    version = _suspension_version(view, name) if name else _fleet_version(view)
    return {"version": version, "words": spoken(current_refresher().words)}


@functools.lru_cache(maxsize=4)
def _calendar(plan: Plan, language: str) -> bytes:
    """Return the calendar in the current `language`, which is here for the cache."""
    from suspnet.report.figures import as_svg
    from suspnet.report.maintenance_figures import plan_calendar

    return as_svg(plan_calendar(plan))


def _suspension_page(name: str, form: AcknowledgementForm) -> str:
    view, state = current_view(), _state(name)
    request.environ[WITH_PLOTS] = True
    results, stored, trouble = [], [], ""
    seen, bad = view.acknowledged.get(state.key, ()), []
    try:
        with opened() as store:
            bad = store.bad_rows
            results, seen = store.read(*state.key), store.acknowledgements(*state.key)
            n_first = current_refresher().board.settings.n_first
            results = relative_results(results, state.series.events, n_first)
            stored = store.responses(*state.key)  # last: damaged curves must not hide the trips
    except HistoryError as error:
        trouble = str(error)
    known = [one for one in view.bad_rows if one.key == state.key]
    shown = page_values.suspension_values(
        view,
        view.keys[name],
        results,
        stored,
        seen,
        lambda of: url_for("pages.trend", name=name, of=of),
    )
    car = next((one for one in view.cars if view.keys[name] in one), [])
    return _page(
        "suspension_page.html",
        "" if form.errors else _suspension_version(view, name),  # a filled form is never replaced
        of=name,
        name=name,
        form=form,
        visitor=visitor(),
        has_work=bool(work_orders(view, view.keys[name])),
        trouble=trouble,
        bad_rows=list(dict.fromkeys([*known, *bad])),
        kinds=page_values.OUTPUTS,
        sisters=[page_values.rows_of(view, car, _address)] if car else [],
        **shown,
    )


def _page(template: str, version: str, of: str = "", **values: Any) -> str:
    """Return a page; the browser replaces it when `version` changes, never if it is empty."""
    refresher = current_refresher()
    where = {"version": version, "of": of, "view": refresher.board.view, "refresher": refresher}
    return render_template(template, **where, **values)


def current_refresher() -> Refresher:
    """Return the thread that holds the state of the fleet."""
    found = current_app.extensions[REFRESHER]
    assert isinstance(found, Refresher)
    return found


def current_access() -> Access:
    """Return who may see and acknowledge."""
    return cast(Access, current_app.extensions[ACCESS])


def current_view() -> FleetView:
    """Return the newest view of the fleet."""
    return current_refresher().board.view


def _state(name: str) -> State:
    """Return a suspension by its name in the URL; abort with 404 if there is none."""
    view = current_view()
    if name not in view.keys:
        abort(404, gettext("There is no such suspension in this history."))
    return view.states[view.keys[name]]


def _choice() -> Choice:
    """Return which suspensions the URL asks for; unknown values choose all."""
    severity = request.args.get("severity", "")
    known = severity in MARKS
    return Choice(request.args.get("train", ""), severity if known else "")


def _address(name: str) -> str:
    return url_for("pages.suspension", name=name)


def opened(wait_s: float = READ_S) -> History:
    """Return the store, without creating a missing one.

    HistoryError is raised if it cannot be used, or is locked for longer than `wait_s`.
    """
    return History(current_refresher().board.store, wait_s=wait_s, must_exist=True)


def _fleet_version(view: FleetView) -> str:
    return _digest(view.at, view.version, current_refresher().fault)


def _suspension_version(view: FleetView, name: str) -> str:
    if name not in view.keys:
        return _digest("gone", current_refresher().fault)
    state = view.states[view.keys[name]]
    series = state.series
    row = {key: value for key, value in view.rows[view.keys[name]].items() if "life" not in key}
    seen = view.acknowledged.get(state.key, ())
    parts = (row, state.alarms, series.events, seen, sorted(state.lives), series.trip.tolist()[-1:])
    return _digest(parts, visits_of(view.plan, state), current_refresher().fault, view.is_complete)


def _minute() -> str:
    """Return when the store was read, with the day: for paper."""
    return day(f"{current_refresher().read_at.astimezone():%Y-%m-%d %H:%M}")


def _digest(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:16]


def _check_plain(form: FlaskForm, field: StringField) -> None:
    if not is_plain(field.data or ""):
        raise ValidationError(N_("Leave out control characters."))


class AcknowledgementForm(FlaskForm):  # type: ignore[misc]
    """Form of an acknowledgement: name, text, and the alarm as the page showed it."""

    by = StringField(
        N_("Your name"),
        [DataRequired(N_("Enter your name.")), Length(max=MOST_NAME), _check_plain],
    )
    words = StringField(N_("Action taken"), [Length(max=500), _check_plain])
    parameter, cause, severity = HiddenField(), HiddenField(), HiddenField()

    def means(self, alarm: Alarm) -> bool:
        """Return whether an alarm is the one of this form, and no worse than shown."""
        same = (alarm.parameter, str(alarm.cause)) == (self.parameter.data, self.cause.data)
        names = {str(one): one for one in Severity}
        return same and alarm.severity <= names.get(self.severity.data or "", -1)
