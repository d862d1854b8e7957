"""The drawing of a bogie's parts: severities, groups, keyboard, plan, and pages without parts."""

import csv
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure
from served_fleet import HEALTHY, WORN, bogie_trips, trips

from suspnet.ground.findings import stored, together
from suspnet.ground.parameters import (
    BOGIE_PARTS,
    COMPONENTS,
    DEFAULT_LIMITS,
    condensed,
    part_words,
)
from suspnet.ground.records import (
    Place,
    SensorHealth,
    sensors_text,
)
from suspnet.runs.language import speaking
from suspnet.trains.fits.worn_parts import WornPart
from suspnet.trains.history import History
from suspnet.trains.jobs.maintenance import write_maintenance
from suspnet.trains.maintenance.series import Event, series_of
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages.board import BoardSettings
from suspnet.trains.pages.bogie import (
    bogie_of,
    group_words,
    worn_entries,
)
from suspnet.trains.pages.output import write_overview
from suspnet.trains.pages.overview import Evaluated
from suspnet.trains.pages.report import Report, write_report
from suspnet.trains.pages.templates import environment
from suspnet.trains.pages.trend import small_trends, trend_of_state

PLACE = Place("", "leading", "", "7", "1")


def worn_words(several):
    return together(one.finding for one in several)


GROUP = WornPart(("k_s_left", "k_s_right"), 30.0, 0.93)
WEAR = {
    "c_p_axle2_left": lambda i: 1 - 0.4 * max(i - 8, 0) / 25,
    "k_p_axle1_right": lambda i: 0.86,
}
TODAY = "2026-03-01"
DETAILS = {"date": "2026-02-27 08:00:00+01:00"}
FADING = dict(enumerate([1, 1, 1, 1, 0.88, 0.755, 0.63, 0.512], 8))  # none is flagged


def worn(i):
    """Return the verdict on a trip: one part is named, of two others which is not known."""
    named = WornPart(("c_p_axle2_left",), 1e6, WEAR["c_p_axle2_left"](i))
    return worn_words([named, GROUP]) if i > 12 else ""


def state_of(results):
    return State(series_of(results), DEFAULT_LIMITS)


def drawn(results, address="#trend-"):
    """Return the HTML of the drawing, without that of the list beside it, and its bogie."""
    found = bogie_of(state_of(results))
    template = environment().get_template("bogie.html").module
    return str(template.drawing(found, "Bogie", address)), found


class Labels(HTMLParser):
    """Attributes of the tags of a page, and its text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words = [], ""
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))

    def handle_data(self, data):
        self.words += data

    def parts(self):
        """Return the elements of parts by the part as a depot calls it."""
        own = [(tag, one) for tag, one in self.tags if "part " in (one.get("class") or "")]
        return {one["aria-label"].split(":")[0]: (tag, one) for tag, one in own}


@pytest.fixture(scope="module")
def results():
    return bogie_trips(PLACE, 1, WEAR, worn)


@pytest.fixture(scope="module")
def report(results, tmp_path_factory):
    """Return the report of a bogie, with a figure of each part."""
    return report_of(with_healthy(results), tmp_path_factory.mktemp("bogie") / "report.html")


def with_healthy(results):
    """Return trips that state the healthy values of their parts, with intervals."""
    values = {name: 1.8e3 for name in BOGIE_PARTS}
    halves = dict.fromkeys(values, 0.029)
    return [replace(one, healthy_si=values, healthy_half_widths=halves) for one in results]


def report_of(results, path):
    state = state_of(results)
    trend = trend_of_state(state)
    small = dict.fromkeys(COMPONENTS, Figure(figsize=(1, 1)))  # quickly drawn
    small |= small_trends(replace(trend, panels=trend.panels[:1]))
    content = Report(results, COMPONENTS, state, DETAILS)
    return write_report(path, "Bogie", content, {}, small).read_text(encoding="utf-8")


# reference: names and groups


def test_parts_are_called_as_in_a_depot():
    assert part_words("c_p_axle2_left") == "damper of axle 2, left"
    assert part_words("k_s_right") == "secondary spring, right"
    assert part_words("c_p") == "c_p"
    assert len({part_words(name) for name in BOGIE_PARTS}) == 12
    assert condensed(COMPONENTS) == ["M_s", "all twelve parts"]
    assert condensed(COMPONENTS[:3]) == list(COMPONENTS[:3])


def test_groups_of_a_verdict_name_their_parts():
    sides = WornPart(("c_p_axle1_left", "c_p_axle1_right"), 25.0, 1.2)
    alone = WornPart(("k_p_axle1_left",), 1e9, 0.5)
    entries = worn_entries(worn_words([sides, alone, GROUP]))
    names = [sides.names, alone.names, GROUP.names]
    assert entries == list(zip(names, ["25 : 1", "over 1000 : 1", "30 : 1"], strict=True))
    assert worn_entries("") == worn_entries("odd text; more (odds 3)") == []
    assert group_words(sides.names, "30 : 1").endswith(" or ".join(map(part_words, sides.names)))


# the drawing


@pytest.mark.parametrize(
    ("ratio", "half", "tone", "sign"),
    [
        (0.5, 0.01, "act", "✕"),
        (0.75, 0.01, "notice", "!"),
        (0.79, 0.2, "plain", "?"),
        (0.99, 0.01, "good", "✓"),
    ],
)
def test_each_severity_has_a_tone_a_sign_and_text(ratio, half, tone, sign):
    name = "c_p_axle1_right"
    few = [
        replace(one, half_widths=one.half_widths | {name: half})
        for one in bogie_trips(PLACE, 1, {name: lambda i: ratio}, n_trips=5)[-1:]
    ]
    page, found = drawn(few)
    one, last = found.parts[name], few[-1]
    (low, high), value = last.interval(name), last.estimates[name]
    shown = re.fullmatch(r"([\d.]+) ± ([\d.]+) %", one.level.replace("\N{NO-BREAK SPACE}", " "))
    assert [float(text) for text in shown.groups()] == pytest.approx(
        [100 * value, 50 * (high - low)], abs=0.051 if half < 0.1 else 0.51
    )
    tag, attributes = Labels(page).parts()["damper of axle 1, right"]
    assert (tag, attributes["class"]) == ("a", f"part {tone}")
    assert one.level in attributes["aria-label"]
    label = {"act": "Act", "notice": "Notice", "plain": "Not judged", "good": "No alarm"}[tone]
    assert f": {label}, " in attributes["aria-label"]
    element = re.search(rf'<a href="#trend-{name}".*?</a>', page, re.S)[0]
    assert f">{sign}</text>" in element
    assert f"<title>{attributes['aria-label']}</title>" in element


def test_left_is_left_axle_1_is_ahead_and_dampers_have_another_shape(results):
    page, _ = drawn(results)
    for name in BOGIE_PARTS:
        element = re.search(rf'<a href="#trend-{name}".*?</a>', page, re.S)[0]
        left, y = map(float, re.search(r'class="box[^"]*" x="(\d+)" y="(\d+)"', element).groups())
        assert (left < 190) == name.endswith("left")
        assert (y < 130) == ("axle1" in name)
        assert (y > 280) == ("axle2" in name)
        assert ("<circle" in element) == (name[0] == "k")
    assert page.index(">axle 1<") < page.index(">axle 2<")
    assert ">forward<" not in page  # axle 1 may be the rear one
    assert ">sensors<" in page


def test_every_part_is_reached_by_the_keyboard_with_a_page_and_without(results, report):
    linked = Labels(drawn(results)[0]).parts()
    assert {one["href"] for _, one in linked.values()} == {f"#trend-{n}" for n in BOGIE_PARTS}
    assert {tag for tag, _ in linked.values()} == {"a"}
    alone = Labels(drawn(results, address="")[0]).parts()
    assert alone.keys() == linked.keys()
    assert all(one["tabindex"] == "0" and one["role"] == "img" for _, one in alone.values())
    ids = [one["id"] for _, one in Labels(report).tags if "id" in one]
    assert len(set(ids)) == len(ids)
    assert {f"trend-{name}" for name in BOGIE_PARTS} <= set(ids)


def test_group_is_shown_as_one(results):
    page, found = drawn(results)
    assert {name for name, one in found.parts.items() if one.group} == set(GROUP.names)
    assert found.parts["k_s_left"].group == "A"
    assert page.count(">A?</text>") == page.count('class="box group"') == 2
    assert ", one of group A" in Labels(page).parts()["secondary spring, right"][1]["aria-label"]
    assert found.groups == {"A": group_words(GROUP.names, "30 : 1")}
    assert "which is not known" in found.groups["A"]
    assert [one.name for one in found.listed] == [
        *("c_p_axle2_left", "k_p_axle1_right"),
        *GROUP.names,
    ]


def test_part_that_is_named_is_marked_with_its_odds_though_it_is_within_its_limits():
    verdict = worn_words([WornPart(("k_s_right",), 400.0, 0.97)])
    page, found = drawn(bogie_trips(PLACE, 1, {"k_s_right": lambda i: 0.97}, lambda i: verdict))
    assert page.count(">worn</text>") == 1
    assert [(one.name, one.severity, one.odds) for one in found.listed] == [
        ("k_s_right", "none", "400 : 1")
    ]
    label = Labels(page).parts()["secondary spring, right"][1]["aria-label"]
    assert label.endswith(", worn, odds 400 : 1")


def test_verdict_is_that_of_the_newest_trip_with_an_estimate(results):
    unread = replace(results[-1], estimates={}, worn="")
    assert drawn([*results[:-1], unread])[1].groups


def test_parts_without_an_estimate_or_interval_are_shown_as_such(results):
    none = [replace(one, estimates={"k_p_axle1_left": 1.0}, half_widths={}) for one in results]
    page, found = drawn(none)
    assert found.parts["c_s_left"].level == "no estimate"
    assert found.parts["c_s_left"].severity == "unknown"
    assert found.parts["k_p_axle1_left"].level == "100.0\N{NO-BREAK SPACE}%"
    flagged, wild = [
        [replace(one, **changes) for one in results]
        for changes in ({"flags": "odd"}, {"estimates": dict.fromkeys(COMPONENTS, 50.0)})
    ]
    assert "±" not in drawn(flagged)[1].parts["c_s_left"].level
    assert drawn(wild)[1].parts["c_s_left"].level == "over\N{NO-BREAK SPACE}1000\N{NO-BREAK SPACE}%"
    assert page.count('class="part ') == 12


def test_group_of_before_the_last_maintenance_is_not_shown(results):
    until = [replace(one, worn=one.worn if one.mileage_km < 40_000 else "") for one in results]
    assert bogie_of(State(series_of(until[:19]), DEFAULT_LIMITS)).groups
    later = Event(39_000.0, "exchanged", "springs")
    assert bogie_of(State(series_of(until, [later]), DEFAULT_LIMITS)).groups == {}
    nothing = replace(series_of(results), worn=np.full(len(results), "", dtype=object))
    assert bogie_of(State(nothing, DEFAULT_LIMITS)).groups == {}


# pages


def test_report_shows_the_bogie_the_worst_first_and_loads_nothing(report):
    assert report.count('<svg class="bogie"') == 1
    assert 'aria-label="damper of axle 2, left: Act' in report
    folded = report.index('<details id="calm">')
    assert report.index('id="trend-c_p_axle2_left"') < report.index('id="trend-k_p_axle1_right"')
    assert report.index('id="trend-k_p_axle1_right"') < folded
    assert folded < report.index('id="trend-c_s_right"')
    assert "Without alarm: 11" in report
    assert 'id="part-c_p_axle2_left"' in report
    assert "http" not in report.replace("http://www.w3.org", "")
    images = [one["src"] for tag, one in Labels(report).tags if tag == "img"]
    assert images
    assert all(one.startswith("data:") for one in images)
    assert "±\N{NO-BREAK SPACE}2.9\N{NO-BREAK SPACE}%" in report


def text_of(page):
    """Return what a reader sees of a page above its table of trips, and in the details."""
    page = re.sub(r"<(style|script).*?</\1>", " ", page, flags=re.DOTALL)
    above, _, below = page.partition('<h2 id="trips">')
    whole = Labels(above + below[below.index('<h2 id="words">') :]).words
    return " ".join(whole.replace("\N{NO-BREAK SPACE}", " ").split())


@pytest.fixture(scope="module")
def fading():
    """Return eight trips on which a damper fades to half."""
    wear = {"c_p_axle2_left": FADING.__getitem__}
    verdict = lambda i: worn_words([WornPart(("c_p_axle2_left",), 1e6, FADING[i])])  # noqa: E731
    health = {
        one: SensorHealth(noise=0.03, faulty=0.0)
        for one in ("axle_box left", "axle_box axle2 right")
    }
    sensors = sensors_text(health)
    found = bogie_trips(PLACE, 1, wear, verdict, n_trips=8, begin=8)
    return [replace(one, quality=replace(one.quality, sensors=sensors)) for one in found]


@pytest.mark.parametrize("language", ["en", "de"])
def test_one_number_leads_and_is_said_in_words(fading, tmp_path, language):
    """It was at 51.2, 57 and 75.5 % on one page: the newest trip, the last two, the last five."""
    with speaking(language):
        text = text_of(report_of(fading, tmp_path / "report.html"))
    state = state_of(fading)
    leading = 100 * state.now("c_p_axle2_left")
    assert leading == pytest.approx(51.2, rel=0.02)
    assert leading == pytest.approx(100 * fading[-1].estimates["c_p_axle2_left"])
    assert not re.search(r"\b(57|63|69|75)([.,]\d)? %", text)
    assert not re.findall(r"\b(?!trip_0)[a-z]+_[a-z]\w*", text)
    if language == "en":
        reason = f"the last trip is at {leading:.0f} % of healthy; the last 2 trips are below the"
        assert text.count(f"{reason} act limit of 70 %; the first 4 trips were at 100 %") == 2
        assert "axle box, left" in text
        assert "axle box of axle 2, right" in text
    else:
        assert "Quote über 1000 : 1" in text
        assert "Achslagergehäuse der Achse 2, rechts" in text
        assert "25.11.2025 bis 16.12.2025" in text
        assert "27.02.2026, 08:00 +01:00" in text
        assert not re.search(r"\d{4}-\d\d-\d\d|Chancen|\b1 \w+en dieses", text)


def test_report_without_parts_draws_none(tmp_path):
    plain = trips(WORN, 2)
    given = Report(plain, ("k_p", "c_p", "k_s", "c_s", "M_s"), state_of(plain))
    page = write_report(tmp_path / "plain.html", "Plain", given, {}).read_text(encoding="utf-8")
    assert "<svg" not in page
    assert '<details id="calm"' not in page


# from the store to the plan


@pytest.fixture(scope="module")
def few():
    """Return the trips of a bogie of which one damper was bad from the first trip on."""
    return bogie_trips(PLACE, 1, {"c_p_axle2_left": lambda i: 0.6}, lambda i: worn(13), n_trips=8)


@pytest.fixture(scope="module")
def store(few, tmp_path_factory):
    path = tmp_path_factory.mktemp("parts") / "fleet.db"
    with History(path) as history:
        history.write(few)
        history.write(trips(HEALTHY, 3, n_trips=5))
    return path


@pytest.mark.usefixtures("blank")
def test_study_names_parts_in_plan_tables_and_overview(store, tmp_path):
    with History(store) as history:
        states = write_maintenance(history, tmp_path, BoardSettings(today=TODAY))
    assert states[0].parameters == "c_p_axle2_left"
    with (tmp_path / "plan.csv").open() as stream:
        jobs = {row["parameter"]: row for row in csv.DictReader(stream)}
    job = jobs["c_p_axle2_left"]
    assert job["part"] == "damper of axle 2, left"
    assert (
        job["visit"]
        == f"replace at the visit of {job['day']}"
        == ("replace at the visit of 2026-03-15")
    )
    with (tmp_path / "overview.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert float(rows[0]["c_p_axle2_left_last"]) == pytest.approx(0.6, abs=0.01)
    assert {row["c_p_axle2_left_last"] for row in rows[1:]} <= {"nan", ""}
    page = (tmp_path / "overview.html").read_text(encoding="utf-8")
    assert page.count('<svg class="bogie"') == 1
    assert page.count('tabindex="0" role="img"') == 12
    assert "damper of axle 2, left</td>" in page
    assert "replace at the visit of 2026-03-15" in page


def test_verdict_comes_back_from_the_store(store, few):
    with History(store) as history:
        series = next(one for one in history.series() if one.place == PLACE)
    assert series.worn.tolist() == [stored(one.worn) for one in few]
    assert series.equals(series_of(few))
    assert not series.equals(series_of([replace(one, worn="") for one in few]))
    assert series.outputs == COMPONENTS


def test_trips_of_both_sides_as_equal_of_earlier_versions_count_no_more(few):
    equal = {"k_p": 0.5, "c_p": 1.0, "k_s": 1.0, "c_s": 1.0, "M_s": 1.0}
    state = state_of([*few[:-1], replace(few[-1], estimates=equal, half_widths={})])
    assert state.outputs == COMPONENTS
    assert {one.parameter for one in state.alarms} <= set(COMPONENTS)
    other = replace(few[-1], estimates=equal, half_widths={}, healthy_since_km=9e5)
    assert state_of([*few, other]).outputs == ("k_p", "c_p", "k_s", "c_s", "M_s")


def test_overview_draws_healthy_bogies_too(few, results, tmp_path):
    healthy = bogie_trips(PLACE, 1, {}, n_trips=3)
    done = [
        Evaluated("a", PLACE, results, state_of(results)),
        Evaluated("b", PLACE, healthy, state_of(healthy)),
        Evaluated("c", PLACE, error="no manifest"),
    ]
    write_overview(done, tmp_path)
    page = (tmp_path / "overview.html").read_text(encoding="utf-8")
    assert page.count('<svg class="bogie"') == 2
    links = [one.get("href", "") for tag, one in Labels(page).tags if tag == "a"]
    reports = [link for link in links if "#" not in link]
    assert reports == ["a/report.html", "b/report.html"] * 2  # of the drawings and in the table


def test_figure_of_the_finding_is_first_and_no_smaller_than_others(fading):
    drawn = small_trends(trend_of_state(state_of(fading)))
    sizes = {name: figure.get_size_inches().prod() for name, figure in drawn.items()}
    assert max(sizes, key=sizes.__getitem__) == "c_p_axle2_left"
    line = next(
        line
        for line in drawn["c_p_axle2_left"].axes[0].lines
        if line.get_label() == "median of five neighbouring trips"
    )
    dots = [100 * one.estimates["c_p_axle2_left"] for one in fading]
    assert line.get_ydata()[3:] == pytest.approx(dots[3:])
