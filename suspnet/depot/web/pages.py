"""The pages: the fleet, one suspension with its figures and forms, the plan."""

from __future__ import annotations

import functools
import hashlib
import threading
from importlib.util import find_spec
from typing import Any

from flask import (
    Blueprint,
    Response,
    abort,
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

from suspnet.depot.web import page_values
from suspnet.depot.web.access import MAX_NAME, identify_visitor, is_plain, visitor
from suspnet.depot.web.figures import response_figure, trend_figure
from suspnet.depot.web.page_values import Choice
from suspnet.depot.web.service import current_service
from suspnet.ground.parameters import Severity
from suspnet.runs.figures import as_svg
from suspnet.runs.language import N_, current, day, gettext, spoken
from suspnet.trains.history import HistoryError
from suspnet.trains.maintenance.alarms import Alarm
from suspnet.trains.maintenance.plan import Plan
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.bogie import visits_of
from suspnet.trains.pages.maintenance_figures import plan_calendar
from suspnet.trains.pages.overview import FleetView
from suspnet.trains.pages.pdf import as_pdf
from suspnet.trains.pages.tables import response
from suspnet.trains.pages.templates import MARKS, render
from suspnet.trains.pages.trend import trend_of_state
from suspnet.trains.pages.work_order import work_orders

WITH_PLOTS = "suspnet.plots"  # key in a request's environment that marks a page with plots
HAS_PDF = find_spec("weasyprint") is not None

pages = Blueprint("pages", __name__)
pages.before_request(identify_visitor)
_drawing, _drawing_calendar = threading.Lock(), threading.Lock()


@pages.get("/")
def fleet() -> ResponseReturnValue:
    """Return the page of the fleet."""
    view, choice = _view(), _choice()
    all_rows = request.args.get("rows") == "all"
    values = page_values.fleet_values(view, choice, all_rows, _address)
    page = _page("fleet_page.html", _fleet_version(view), **values)
    return page, 503 if view.trouble and not view.states else 200


@pages.get("/plan")
def plan() -> ResponseReturnValue:
    """Return the page of the plan."""
    view, choice = _view(), _choice()
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
    plan = _view().plan
    if plan is None:
        abort(404)
    with _drawing_calendar:  # around the cache: of those that wait, only the first one draws
        return Response(_calendar(plan, current()), mimetype="image/svg+xml")


@functools.lru_cache(maxsize=4)
def _calendar(plan: Plan, language: str) -> bytes:
    """Return the calendar in the current `language`, an argument for the cache alone."""
    return as_svg(plan_calendar(plan))


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
    chosen = [alarm for alarm in state.alarms if form.means(alarm)]
    if not chosen:
        flash(
            gettext("Nothing was acknowledged: this alarm is cleared, or worse than it was shown.")
        )
        return redirect(_address(name))
    by, action = form.by.data.strip(), (form.words.data or "").strip()
    current_service().acknowledge(state, chosen, by, action)
    session["by"] = by
    alarms = ", ".join(f"{alarm.parameter} ({gettext(str(alarm.cause))})" for alarm in chosen)
    words = gettext("Acknowledged by %(name)s: %(alarms)s.")
    flash(words % {"name": by, "alarms": alarms})
    return redirect(_address(name))


@pages.get("/suspension/<name>/work-order")
def work_order(name: str) -> ResponseReturnValue:
    """Return the work orders of a suspension as a page to print."""
    version = _suspension_version(_view(), name)
    values = _orders(name) | {"of": name, "name": name, "has_pdf": HAS_PDF}
    return _page("work_order_page.html", version, **values)


@pages.get("/suspension/<name>/work-order.pdf")
def work_order_pdf(name: str) -> ResponseReturnValue:
    """Return the work orders of a suspension as PDF."""
    if not HAS_PDF:
        abort(
            404,
            gettext("Work orders as PDF need WeasyPrint where suspnet-serve runs: the extra pdf."),
        )
    page = render("work_order_print.html", **_orders(name))
    if not _drawing.acquire(blocking=False):  # it takes seconds, and requests must not queue up
        abort(503)
    try:
        return Response(as_pdf(page), mimetype="application/pdf")
    finally:
        _drawing.release()


def _orders(name: str) -> dict[str, Any]:
    """Return the values that both pages of work orders show."""
    _state(name)
    view, read_at = _view(), current_service().refresher.read_at.astimezone()
    index = view.keys[name]
    # with the day: for paper
    read_day = day(f"{read_at:%Y-%m-%d %H:%M}")
    return {"row": view.rows[index], "orders": work_orders(view, index), "read_at": read_day}


@pages.get("/suspension/<name>/trend.json")
def trend(name: str) -> ResponseReturnValue:
    """Return the figure of the parameters along the mileage, or `of` one of them."""
    trend, of = trend_of_state(_state(name)), request.args.get("of", "")
    if of and of not in [panel.name for panel in trend.panels]:
        abort(404)
    return trend_figure(trend, name, of)


@pages.get("/suspension/<name>/responses.json")
def responses(name: str) -> ResponseReturnValue:
    """Return the figure of the frequency responses."""
    with current_service().opened() as store:
        stored = store.responses(*_state(name).key)
    if not stored:
        abort(404)
    shown = [response(curves.trip, curves.mileage_km, curves) for curves in stored]
    return response_figure(shown, name)


@pages.get("/state")
def state() -> ResponseReturnValue:
    """Return the version of a page's state and when it was read; cheap, as pages poll it."""
    view, name = _view(), request.args.get("of", "")
    version = _suspension_version(view, name) if name else _fleet_version(view)
    return {"version": version, "words": spoken(current_service().refresher.words)}


def _suspension_page(name: str, form: AcknowledgementForm) -> str:
    view, state, service = _view(), _state(name), current_service()
    request.environ[WITH_PLOTS] = True
    results, stored, trouble = [], [], ""
    seen, bad_rows = view.acknowledged.get(state.key, ()), []
    try:
        with service.opened() as store:
            bad_rows = store.bad_rows
            results, seen = service.trips(store, state), store.acknowledgements(*state.key)
            stored = store.responses(*state.key)  # last: damaged curves must not hide the trips
    except HistoryError as error:
        trouble = str(error)
    index = view.keys[name]
    shown = page_values.suspension_values(
        view, index, results, stored, seen, lambda of: url_for("pages.trend", name=name, of=of)
    )
    bad_rows = [*(row for row in view.bad_rows if row.key == state.key), *bad_rows]
    car = next((indices for indices in view.cars if index in indices), [])
    return _page(
        "suspension_page.html",
        "" if form.errors else _suspension_version(view, name),  # a filled form is never replaced
        of=name,
        name=name,
        form=form,
        visitor=visitor(),
        has_work=bool(work_orders(view, index)),
        trouble=trouble,
        bad_rows=list(dict.fromkeys(bad_rows)),
        kinds=page_values.OUTPUTS,
        sisters=[page_values.rows_of(view, car, _address)] if car else [],
        **shown,
    )


def _page(template: str, version: str, of: str = "", **values: Any) -> str:
    """Return a page; the browser replaces it when `version` changes, never if it is empty."""
    shared = {"view": _view(), "refresher": current_service().refresher}
    return render_template(template, version=version, of=of, **shared, **values)


def message_page(title: str, words: str) -> str:
    """Return a page with a message alone."""
    return _page("message_page.html", "", title=title, words=words)


def _view() -> FleetView:
    return current_service().view


def _state(name: str) -> State:
    """Return a suspension by its name in the URL; abort with 404 if there is none."""
    view = _view()
    if name not in view.keys:
        abort(404, gettext("There is no such suspension in this history."))
    return view.states[view.keys[name]]


def _choice() -> Choice:
    """Return which suspensions the URL asks for; unknown values choose all."""
    severity = request.args.get("severity", "")
    return Choice(request.args.get("train", ""), severity if severity in MARKS else "")


def _address(name: str) -> str:
    return url_for("pages.suspension", name=name)


def _fleet_version(view: FleetView) -> str:
    return _digest(view.at, view.version)


def _suspension_version(view: FleetView, name: str) -> str:
    if name not in view.keys:
        return _digest("gone")
    state, row = view.states[view.keys[name]], view.rows[view.keys[name]]
    return _digest(
        {key: value for key, value in row.items() if "life" not in key},
        (state.alarms, state.series.events, sorted(state.lives)),
        state.series.trip.tolist()[-1:],
        view.acknowledged.get(state.key, ()),
        visits_of(view.plan, state),
        view.is_complete,
    )


def _digest(*values: Any) -> str:
    values = (*values, current_service().refresher.fault)
    return hashlib.sha256(repr(values).encode()).hexdigest()[:16]


def _check_plain(form: FlaskForm, field: StringField) -> None:
    if not is_plain(field.data or ""):
        raise ValidationError(N_("Leave out control characters."))


class AcknowledgementForm(FlaskForm):  # type: ignore[misc]
    """Form of an acknowledgement: name, text, and the alarm as the page showed it."""

    by = StringField(
        N_("Your name"),
        [DataRequired(N_("Enter your name.")), Length(max=MAX_NAME), _check_plain],
    )
    words = StringField(N_("Action taken"), [Length(max=500), _check_plain])
    parameter, cause, severity = HiddenField(), HiddenField(), HiddenField()

    def means(self, alarm: Alarm) -> bool:
        """Return whether an alarm is the one of this form, and no worse than shown."""
        same = (alarm.parameter, str(alarm.cause)) == (self.parameter.data, self.cause.data)
        severities = {str(severity): severity for severity in Severity}
        return same and alarm.severity <= severities.get(self.severity.data or "", -1)
