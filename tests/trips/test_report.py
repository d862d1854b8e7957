"""The report is one file that stands alone, shows every trip and escapes what it is given."""

import base64
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure
from trip_records import FLAG, HALF_WIDTHS, OUTPUTS, flagged, fleet, trend_of, trip

from suspnet.ground.findings import WITHOUT_SENSORS, Finding, of, together
from suspnet.ground.parameters import DEFAULT_LIMITS, Cause
from suspnet.ground.records import Place
from suspnet.runs import figures
from suspnet.runs.language import speaking
from suspnet.trains.maintenance import Acknowledgement, Alarm, Life, Severity
from suspnet.trains.maintenance.alarms import Watched
from suspnet.trains.maintenance.series import make_series, series_of
from suspnet.trains.maintenance.state import State
from suspnet.trains.pages import report, trip_figures
from suspnet.trains.pages.failing_sensors import dead_words, failing_sensors, failing_words
from suspnet.trains.pages.overview import Evaluated
from suspnet.trains.pages.report import Report
from suspnet.trains.pages.tables import files_read_as
from suspnet.trains.pages.trend import health_trend

HOSTILE = "<script>alert('x')</script> & \"$x_\" {{ 7 * 7 }} \u5217\u8eca \udcff"
VOID = {"meta", "br", "img"}


class Page(HTMLParser):
    """A page's tags, attributes and text; a tag that is not closed is an error."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self._open = [], [], []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)

    def named(self, name):
        return [attributes for tag, attributes in self.tags if tag == name]

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())


def state_of(results, **changes):
    """Return the state that trips show, without the search for changes."""
    undated = [replace(one, start="") for one in results]
    return State(series_of(undated) if results else make_series([], {}), DEFAULT_LIMITS, **changes)


def small_figure():
    figure = Figure(figsize=(2, 2))
    figure.subplots().plot([1, 2])
    return figure


def write(path, results, drawn=None, details=None, title="Suspension report", level=0.9):
    drawn = {} if drawn is None else drawn  # a figure takes longer than the page
    details = {"model": "msvr"} if details is None else details
    given = Report(results, OUTPUTS, state_of(results), details, level)
    report.write_report(path, title, given, drawn)
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a report with all figures: its text, page and trips."""
    results = fleet()
    drawn = {
        "signals": small_figure(),
        "extra_figure": small_figure(),
        "responses": small_figure(),
        "trend": health_trend(trend_of(results)),
    }
    path = tmp_path_factory.mktemp("report") / "report.html"
    return *write(path, results[::-1], drawn, {"model": "msvr", "date": "2024-11-03"}), results


def test_every_trip_and_reason_appears_in_the_order_of_the_mileage(whole):
    _, page, results = whole
    places = [page.text.index(f" {r.trip} ") for r in results]
    assert places == sorted(places)
    for result in results:
        assert result.reason in page.text
    missing = [a for a in page.named("tr") if a.get("class") == "missing"]
    assert len(missing) == sum(r.status != "ok" for r in results) == 2
    assert page.text.count("no estimate: only") == 2


def test_headline_and_verdicts_appear(whole):
    _, page, results = whole
    words = page.text.replace("\N{NO-BREAK SPACE}", " ")
    assert "AM96 217" in words
    assert "bogie 1, left" in words
    assert "10 000 to 300 000 km" in words
    assert "30, of which 28 with an estimate" in words
    assert "Act: c s (suspension bogie 1, left) 1 of 4 parameters is beyond" in words
    for one in state_of(results).assessments:
        assert one.words in words
    assert words.count("▲") == 4  # k_p and c_s, and where the mark is explained
    assert "fell by 1 % at about 245 000 km, within its limits" in words
    assert "80 to 125 70 to 140" in words  # the limits of a damper
    assert "They do not show lateral and yaw dampers" in words


def test_nothing_is_loaded_from_elsewhere(whole):
    text, page, _ = whole
    without_images = re.sub(r"base64,[^\"]*", "", text)
    assert not re.search(r"//|@import|url\(", without_images)
    names = {name for name, _ in page.tags}
    assert not names & {"script", "link", "iframe", "object", "base", "form", "a"}
    images = [image["src"].partition(";base64,") for image in page.named("img")]
    contents = [base64.b64decode(source, validate=True) for _, _, source in images]
    assert {kind for kind, _, _ in images} <= {"data:image/svg+xml", "data:image/png"}
    assert len(contents) == 4
    for content in contents:
        assert content.startswith((b"<?xml", b"\x89PNG"))
        if content.startswith(b"<?xml"):
            links = re.findall(rb'(?:href|src)="([^"]*)"', content)
            assert all(link.startswith((b"#", b"data:")) for link in links)
            assert b"<script" not in content
    # known figures come first, and all have texts
    texts = [image["alt"].partition(".")[0] for image in page.named("img")]
    known = ["Health along the mileage", "How the suspension passes vibration on"]
    assert texts == [*known, "Signals of one trip", "Extra figure"]
    assert page.text.count("How to read this:") == len(report.FIGURES)


def test_page_is_accessible(whole):
    _, page, _ = whole
    assert page.named("html") == [{"lang": "en"}]
    assert all("scope" in header for header in page.named("th"))
    assert len(page.named("caption")) == len(page.named("table")) == 2
    assert {"name": "viewport", "content": "width=device-width, initial-scale=1"} in page.named(
        "meta"
    )
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert all(a["aria-labelledby"] in ids for _, a in page.tags if "aria-labelledby" in a)


def test_hostile_names_are_escaped(tmp_path):
    quality = replace(trip().quality, faults=HOSTILE, warnings=HOSTILE)
    fields = {"trip": HOSTILE, "vehicle": HOSTILE, "place": Place(HOSTILE), "start": HOSTILE}
    results = [
        trip(0, quality=quality, flags=HOSTILE, **fields),
        trip(1, missing=True, **(fields | {"reason": HOSTILE})),
    ]
    drawn = {HOSTILE: small_figure(), "signals": trip_figures.trip_signals(results[0])}
    text, page = write(tmp_path / "r.html", results, drawn, {HOSTILE: HOSTILE}, HOSTILE)
    assert page.named("script") == []
    assert "<script" not in text.lower()
    assert unescape(text).count("alert('x')") > 10
    assert "{{ 7 * 7 }}" in page.text
    assert "49" not in page.named("img")[0]["alt"]


@pytest.mark.parametrize(
    ("results", "sentence"),
    [
        ([trip()], "beyond its limits; there are too few trips to find a change"),
        ([], "No trip has an estimate"),
        (
            [trip(i) if i > 4 else trip(i, estimates={"k_p": 1.0}) for i in range(12)],
            "there are too few trips to find a change",
        ),
    ],
)
def test_finding_fits_what_is_known(tmp_path, results, sentence):
    _, page = write(tmp_path / "r.html", results)
    assert sentence in page.text
    assert "nan" not in page.text.lower().split()


def test_unknown_numbers_are_dashes(tmp_path):
    failed = trip(missing=True, status="error", quality=type(trip().quality)(), start="")
    unknown = trip(1, half_widths=dict.fromkeys(OUTPUTS, np.inf))
    results = [replace(failed, mileage_km=np.nan), unknown]
    text, page = write(tmp_path / "r.html", results)
    assert "error: only 0 averages" in page.text
    assert '<td class="n">\N{EN DASH}</td>' in text
    assert re.findall("<small>(.*?)</small>", text) == ["too few trips (1 of 5)"] * 4
    assert not {"nan", "inf"} & set(page.text.lower().split())


def measured(n=12, **options):
    return [replace(trip(i, **options), half_widths=HALF_WIDTHS) for i in range(n)]


@pytest.mark.parametrize(("half", "shown"), [(0.3, "30.5"), (0.0003, "0.03")])
def test_estimates_have_as_many_digits_as_their_half_widths(tmp_path, half, shown):
    si = {"healthy_si": {"k_p": 1.3e6}, "healthy_half_widths": {"k_p": 0.02}}
    given = {"estimates": dict.fromkeys(OUTPUTS, 1.0), "half_widths": dict.fromkeys(OUTPUTS, half)}
    text, page = write(tmp_path / "r.html", [trip(**given, **si)], level=0.95)
    digits = len(shown.partition(".")[2])
    assert text.count(f"{100:.{digits}f}<small> ± {shown}</small>") == 2 * len(
        OUTPUTS
    )  # also for a phone
    assert "1300 kN/m ± 2 %" in page.text
    assert "100 % is: ± half of its 95 % interval." in page.text


@pytest.mark.parametrize("n_flagged", [1, 2, 12])
def test_flagged_trips_are_told_with_their_reasons(tmp_path, n_flagged):
    results = measured()
    results[3] = flagged(results[3], k_p=1.4e5)
    for i in [i for i in range(12) if i != 3][: n_flagged - 1]:
        results[i] = flagged(results[i])
    text, page = write(tmp_path / "r.html", results, {"trend": small_figure()})
    count = {1: "1 of 12 trips is flagged", 2: "2 of 12 trips are flagged"}
    assert count.get(n_flagged, "All 12 trips are flagged") in page.text
    assert f"12, of which 12 with an estimate, {n_flagged} of these flagged" in page.text
    assert page.named("div")[0]["class"] == "result plain"  # else it would be good
    for tag in ("tr", "li"):  # the second is shown on a phone
        assert [a.get("class") for a in page.named(tag)].count("flagged") == n_flagged
    assert page.text.count(f"⚑ {FLAG}") == n_flagged
    row = text[text.index("trip_003") : text.index("trip_004")]
    assert "over 1000</td>" in row  # without an interval, and no number that no suspension has
    assert "±" not in row
    assert "A hollow circle is a flagged trip" in page.text
    # one sentence for all parameters is written once above and once in the table
    assert page.text.count("not judged, as all trips are flagged") == 2 * (n_flagged == 12)
    assert (page.text.count("as above") >= 3) == (n_flagged == 12)


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("k_s", "tone"), [(1.0, "good"), (1.15, "notice"), (1.5, "act"), (0.99, "plain")]
)
def test_colour_and_label_are_those_of_the_severity(tmp_path, k_s, tone):
    """A change of 1 % over the last six trips and a loss of the air spring do not look alike."""
    n_last = 6 if k_s == 0.99 else 2
    results = [
        replace(
            r, estimates=dict.fromkeys(OUTPUTS, 1.0) | {"k_s": k_s if i >= 12 - n_last else 1.0}
        )
        for i, r in enumerate(measured())
    ]
    text, page = write(tmp_path / "r.html", results)
    assert page.named("div")[0]["class"] == f"result {tone}"
    label = {"act": "Act", "notice": "Notice"}.get(tone)
    shown = re.search(rf'<span class="label {tone}">.*</span> {label}\s*</span>', text)
    assert bool(shown) == bool(label)
    assert ("the last 2 trips are above" in page.text) == bool(label)
    assert ("Nothing stands out" in page.text) == (tone == "good")
    assert ("fell by 1 % at about 65 000" in page.text) == (tone == "plain")


def with_faults(result, faults, **changes):
    return replace(result, quality=replace(result.quality, faults=faults, **changes))


def test_dead_and_failing_sensors_are_named(tmp_path):
    reason = Finding("is-constant", value=0.0)
    dead = of("bogie right", Finding("dead-read-alone", place="bogie", side="left", reason=reason))
    results = [with_faults(r, dead if i > 9 else "") for i, r in enumerate(measured())]
    _, page = write(tmp_path / "r.html", results)
    assert "Sensors: dead and left out: bogie frame, right (on 2 of 12 trips)" in page.text
    assert page.named("div")[0]["class"] != "result good"
    row = Evaluated("a", results[0].place, results, state_of(results)).row()
    assert row["sensors"] == "dead and left out: bogie right (on 2 of 12 trips)"
    repaired = [*results, replace(results[0], mileage_km=1e6)]
    assert dead_words(repaired) == ""
    assert "bogie right (on 2 of the last 5 trips)" in failing_words(repaired)
    assert failing_words([*repaired, *repaired[-1:] * 4]) == ""
    # sensors that parts are read without are named once
    loose = of("bogie right", Finding("loose", first=8.0, last=20.0))
    names = ("bogie right", "body left")
    without = Finding(WITHOUT_SENSORS, names=names, listed=together(names, ", "))
    faults = together((loose, "body: spike"))
    results = [with_faults(r, faults, warnings=without) for r in measured()[:2]]
    trips = [r.trip for r in results]
    assert failing_sensors(results) == {loose: trips, "body left: not used for the parts": trips}
    assert "bogie right, body left (on 2 of the last 2 trips)" in failing_words(results)


def test_alarms_and_remaining_life_are_shown(tmp_path):
    results = fleet(6, missing=(), with_curves=False)
    alarms = [
        Alarm("k_p", Cause.CHANGE, Severity.NOTICE, 1e4, 2e4, "fell by 1 % at about 9 000 km"),
        Alarm("c_s", Cause.LIMIT, Severity.ACT, 3e4, words="at 60 % of <healthy>"),
    ]
    seen = [Acknowledgement("c_s", Cause.LIMIT, Severity.ACT, 4e4, "Kim", "2026-02-01T00:00+00:00")]
    lives = {"k_p": Life("linear", np.linspace(1e5, 2e5, 11)), "c_p": Life("no trend", np.zeros(1))}
    state = state_of(results, lives=lives, watched=Watched(alarms))
    given = Report(results, OUTPUTS, state, seen=seen)
    report.write_report(tmp_path / "r.html", "Suspension report", given, {"trend": small_figure()})
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    table = text[text.index('<h2 id="alarms">') :]
    # active alarms come first
    assert table.index("at 60 % of &lt;healthy&gt;".replace(" %", "\N{NO-BREAK SPACE}%")) < (
        table.index("fell by")
    )
    assert "seen by Kim, 2026-02-01" in table
    assert "active" in table
    plain = text.replace("\N{NO-BREAK SPACE}", " ")
    assert "150 000<small>110 000 to 190 000</small>" in plain
    assert '<td class="n life">passed</td>' in text


def test_how_files_were_read_is_a_detail_and_no_fault(tmp_path):
    def read(result, *files):
        known = {"header": "no names", "first_line": 1, "encoding": "utf-8", "bom": ""}
        words = together(
            of(name, Finding("csv-dialect", delimiter=sign, decimal="','", **known))
            for name, sign in files
        )
        return replace(result, quality=replace(result.quality, read_as=words, faults=""))

    results = [read(r, ("axle_box.csv", "tab")) for r in measured()]
    results[4] = read(results[4], ("axle_box.csv", "tab"), ("b.csv", "';'"), ("c.csv", "';'"))
    details = files_read_as(results)
    words = results[0].quality.read_as.values["words"]
    other = words.replace("tab", "';'")
    assert details == {"files read as": f"{words} (12 files) · {other} (2 files)"}
    assert files_read_as(measured()) == {}
    text, page = write(tmp_path / "r.html", results, details=details)
    assert page.text.count(words) == 1
    assert text.index("delimiter") > text.index(">Details</h2>")


def test_report_is_german_where_that_is_chosen(tmp_path):
    results = measured()
    results[3] = flagged(results[3], k_p=0.27)
    with speaking("de"):
        text, page = write(tmp_path / "r.html", results, {"trend": small_figure()}, title="Bericht")
    said = page.text.replace("\N{NO-BREAK SPACE}", " ")
    assert '<html lang="de">' in text
    assert "Nichts fällt auf. Kein Parameter ist jenseits seiner Grenzen" in said
    assert "1 von 12 Fahrten ist markiert, siehe Tabelle; k_p bei etwa 27 % liegt außerhalb" in said
    assert "12, davon 12 mit einer Schätzung, davon 1 markiert" in said
    assert "Steifigkeit der Primärfeder, zwischen Achslagergehäuse und Drehgestellrahmen." in said
    assert not re.search(r"\b(the|trips?|of|healthy|are|suspension)\b", said.partition("*/")[2])


def test_texts_of_figures_are_german_but_not_what_ticks_name():
    figure = Figure(layout="constrained")
    axis = figure.subplots()
    label, title = Finding("of-healthy-axis", symbol="$k_p$"), Finding("trip-at", km=3000.0)
    axis.set(ylabel=label, xlabel="mileage [1000 km]", title=title)
    axis.plot([0, 1], label="act limit")
    axis.set_yticks([0, 1], ["train left", "right"])
    figure.legend()
    with speaking("de"):
        image = figures.as_svg(figure)
    assert image
    shown = [axis.get_ylabel(), axis.get_xlabel(), axis.get_title()]
    assert shown == ["$k_p$ [% Referenz]", "Laufleistung [1000 km]", "Fahrt bei 3 000 km"]
    assert figure.legends[0].get_texts()[0].get_text() == "Eingriffsgrenze"
    assert [one.get_text() for one in axis.get_yticklabels()] == ["train left", "right"]
