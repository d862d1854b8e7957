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

from suspnet.ground.parameters import DEFAULT_LIMITS
from suspnet.ground.records import Place, Quality
from suspnet.maintenance import Acknowledgement, Alarm, Cause, Life, Severity
from suspnet.maintenance.alarms import Watched
from suspnet.maintenance.series import make_series, series_of
from suspnet.maintenance.state import State
from suspnet.report import figures, report
from suspnet.report.failing_sensors import dead_words, failing_sensors, failing_words
from suspnet.report.language import speaking
from suspnet.report.maintenance_figures import health_trend
from suspnet.report.overview import Evaluated
from suspnet.report.report import Report
from suspnet.report.tables import files_read_as

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
        "quality": small_figure(),
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
    assert "falls by 1.1 % at about 240 000 km, within its limits" in words
    assert "80 to 125 70 to 140" in words  # the limits of a damper
    assert "They do not show lateral and yaw dampers" in words


def test_numbers_are_percent_of_healthy_and_km_per_hour(whole):
    text, _, results = whole
    cells = re.findall(r'<td class="n">([^<]*)</td>', text)
    assert f"{100 * results[0].estimates['k_p']:.1f}" in cells
    assert "252" in cells
    assert "300\N{NO-BREAK SPACE}000" in cells


def test_nothing_is_loaded_from_elsewhere(whole):
    text, page, _ = whole
    without_images = re.sub(r"base64,[^\"]*", "", text)
    assert not re.search(r"//|@import|url\(", without_images)
    names = {name for name, _ in page.tags}
    assert not names & {"script", "link", "iframe", "object", "base", "form", "a"}
    for image in page.named("img"):
        assert image["src"].startswith(("data:image/svg+xml;base64,", "data:image/png;base64,"))


def test_inlined_figures_refer_to_nothing_outside(whole):
    _, page, _ = whole
    sources = [image["src"].partition(",")[2] for image in page.named("img")]
    contents = [base64.b64decode(source, validate=True) for source in sources]
    assert len(contents) == 5
    for content in contents:
        assert content.startswith((b"<?xml", b"\x89PNG"))
        if content.startswith(b"<?xml"):
            links = re.findall(rb'(?:href|src)="([^"]*)"', content)
            assert all(link.startswith((b"#", b"data:")) for link in links)
            assert b"<script" not in content


def test_known_figures_come_first_and_all_have_texts(whole):
    _, page, _ = whole
    texts = [image["alt"] for image in page.named("img")]
    headings = [heading for heading, _ in report.CAPTIONS.values()] + ["Extra figure"]
    assert [text.partition(".")[0] for text in texts] == headings
    assert page.text.count("How to read this:") == len(report.CAPTIONS)


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
    drawn = {HOSTILE: small_figure(), "signals": figures.trip_signals(results[0])}
    text, page = write(tmp_path / "r.html", results, drawn, {HOSTILE: HOSTILE}, HOSTILE)
    assert page.named("script") == []
    assert "<script" not in text.lower()
    assert unescape(text).count("alert('x')") > 10
    assert "{{ 7 * 7 }}" in page.text
    assert "49" not in page.named("img")[0]["alt"]


@pytest.mark.representatives(3)
@pytest.mark.parametrize(
    ("results", "sentence"),
    [
        ([trip()], "beyond its limits; there are too few trips to find a change"),
        ([trip(i, missing=True) for i in range(3)], "No trip has an estimate"),
        ([], "No trip has an estimate"),
        ([trip(i) for i in range(12)], "Nothing stands out. No parameter is beyond its limits"),
        (
            [trip(i) if i > 4 else trip(i, estimates={"k_p": 1.0}) for i in range(12)],
            "some parameters have too few trips to find a change",
        ),
    ],
)
def test_finding_fits_what_is_known(tmp_path, results, sentence):
    _, page = write(tmp_path / "r.html", results)
    assert sentence in page.text
    assert "nan" not in page.text.lower().split()


def test_unknown_numbers_are_dashes(tmp_path):
    failed = trip(missing=True, status="error", quality=type(trip().quality)(), start="")
    text, page = write(tmp_path / "r.html", [replace(failed, mileage_km=np.nan)])
    assert "error: only 0 averages" in page.text
    assert "Mileage unknown" in page.text
    assert '<td class="n">\N{EN DASH}</td>' in text


def measured(n=12, **options):
    return [replace(trip(i, **options), half_widths=HALF_WIDTHS) for i in range(n)]


def test_estimates_have_their_half_widths_in_small_print(tmp_path):
    results = measured()
    text, _ = write(tmp_path / "r.html", results)
    cells = re.findall(r'<td class="n">([^<]*)<small> ± ([^<]*)</small></td>', text)
    assert len(cells) == len(results) * len(OUTPUTS)
    for result, row in zip(results, np.reshape(cells, (-1, len(OUTPUTS), 2)), strict=True):
        for name, (value, half) in zip(OUTPUTS, row, strict=True):
            low, high = result.interval(name)
            assert float(value) == pytest.approx(100 * result.estimates[name], abs=0.051)
            assert float(half) == pytest.approx(50 * (high - low), abs=0.051)


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("half", "shown"), [(0.3, "30.5"), (0.003, "0.3"), (0.0003, "0.03"), (0.00003, "0.003")]
)
def test_estimates_have_as_many_digits_as_their_half_widths(tmp_path, half, shown):
    result = trip(estimates=dict.fromkeys(OUTPUTS, 1.0), half_widths=dict.fromkeys(OUTPUTS, half))
    text, _ = write(tmp_path / "r.html", [result])
    digits = len(shown.partition(".")[2])
    assert f"{100:.{digits}f}<small> ± {shown}</small>" in text


def test_flagged_trips_are_told_with_their_reasons(tmp_path):
    results = measured()
    results[3] = flagged(results[3], k_p=0.27)
    results[7] = flagged(results[7])
    text, page = write(tmp_path / "r.html", results, {"trend": small_figure()})
    assert "2 of 12 trips are flagged, see the table; " in page.text
    assert "12, of which 12 with an estimate, 2 of these flagged" in page.text
    assert page.named("div")[0]["class"] == "result plain"  # else it would be good
    assert [a.get("class") for a in page.named("tr")].count("flagged") == 2
    assert [a.get("class") for a in page.named("li")].count("flagged") == 2  # on a phone
    assert page.text.count(f"⚑ {FLAG}") == 2
    row = text[text.index("trip_003") : text.index("trip_004")]
    assert "27.0</td>" in row  # without an interval
    assert "±" not in row
    assert "Violet ones are flagged" in page.text
    assert "A hollow circle is a flagged trip" in page.text


def test_a_level_that_no_suspension_has_is_no_number_in_the_table(tmp_path):
    results = measured()
    results[3] = flagged(results[3], k_p=1.4e5)
    text, _ = write(tmp_path / "r.html", results)
    row = text[text.index("trip_003") : text.index("trip_004")]
    assert "over 1000</td>" in row
    assert "14000000" not in row


@pytest.mark.parametrize(
    ("n", "sentence"),
    [
        (1, "1 of 6 trips is flagged, see the table; "),
        (
            6,
            "All 6 trips are flagged, so their numbers may be further off than the intervals say; ",
        ),
    ],
)
def test_sentence_on_flags_is_grammatical(tmp_path, n, sentence):
    results = [flagged(r) if i < n else r for i, r in enumerate(measured(6))]
    _, page = write(tmp_path / "r.html", [*results, trip(7, missing=True)])
    assert sentence in page.text


def test_trips_without_an_estimate_are_told_with_their_reasons(tmp_path):
    done = measured(6)
    missing = [trip(n, missing=True) for n in (7, 8)]
    reason = missing[0].reason
    _, page = write(tmp_path / "a.html", [*done, missing[0]])
    assert f"1 of 7 trips has no estimate, see the table; {reason}." in page.text
    assert page.named("div")[0]["class"] == "result plain"
    _, page = write(tmp_path / "b.html", [*done, *missing])
    assert f"2 of 8 trips have no estimate, see the table; 1 of them: {reason}." in page.text
    for name, trips in (("c.html", done), ("d.html", missing)):
        _, page = write(tmp_path / name, trips)
        assert "no estimate, see the table" not in page.text


def test_page_speaks_of_intervals_and_flags_only_where_there_are_some(tmp_path):
    _, plain = write(tmp_path / "a.html", fleet(12, ()))
    _, known = write(tmp_path / "b.html", measured(), level=0.95)
    for words in ("95 % interval", "on 95 of 100 trips", "± is half of their 95 % interval"):
        assert words not in plain.text
        assert words in known.text
    assert "Interval, ±" not in plain.text
    for page in (plain, known):
        assert "flagged:" not in page.text
        assert "violet" not in page.text
        assert "hollow circle" not in page.text


@pytest.mark.parametrize("half", [np.nan, np.inf])
def test_unknown_half_widths_are_left_out(tmp_path, half):
    results = [trip(half_widths=dict.fromkeys(OUTPUTS, half))]
    text, page = write(tmp_path / "r.html", results)
    assert re.findall("<small>(.*?)</small>", text) == ["too few trips (1 of 5)"] * 4
    assert not {"nan", "inf"} & set(page.text.lower().split())


def test_large_figures_are_embedded_as_png(tmp_path):
    figure = Figure()
    figure.subplots().scatter(*np.random.default_rng(0).normal(size=(2, 6000)))
    _, page = write(tmp_path / "r.html", [trip()], {"large": figure})
    assert page.named("img")[0]["src"].startswith("data:image/png;base64,")


def test_same_results_give_the_same_file(tmp_path):
    first, _ = write(tmp_path / "a.html", [trip()], {"trend": small_figure()})
    second, _ = write(tmp_path / "b.html", [trip()], {"trend": small_figure()})
    assert first == second


def test_a_folder_that_is_a_file_is_reported(tmp_path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(OSError, match="taken"):
        write(tmp_path / "taken" / "report.html", [trip()])


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
    assert ("falls by 1.0 % " in page.text) == (tone == "plain")


def test_first_sentence_names_three_findings_and_counts_the_others(tmp_path):
    ratios = {"k_p": 0.6, "c_p": 0.5, "k_s": 0.6, "c_s": 0.5}
    _, page = write(tmp_path / "r.html", [flagged(r, **ratios) for r in measured()])
    named = report.named_first(state_of([flagged(r, **ratios) for r in measured()]).assessments, [])
    assert named == "Act: k_p; c_p; k_s and 1 more"
    assert "Act: k p ; c p ; k s and 1 more" in page.text
    assert report.named_first(state_of(measured()).assessments, []) == ""


def test_dead_sensor_is_named_at_the_top(tmp_path):
    dead = "bogie right: dead and left out, bogie is read by its left sensor alone: it is constant"
    results = [
        replace(r, quality=replace(r.quality, faults=dead if i > 9 else ""))
        for i, r in enumerate(measured())
    ]
    _, page = write(tmp_path / "r.html", results)
    assert "Sensors: dead and left out: bogie frame, right (on 2 of 12 trips)" in page.text
    assert page.named("div")[0]["class"] != "result good"
    row = Evaluated("a", results[0].place, results, state_of(results)).row(OUTPUTS)
    assert row["sensors"] == "dead and left out: bogie right (on 2 of 12 trips)"
    repaired = [*results, replace(results[0], mileage_km=1e6)]
    assert dead_words(repaired) == ""
    assert (
        failing_words(repaired) == "dead, loose or not used: bogie right (on 2 of the last 5 trips)"
    )
    assert failing_words([*repaired, *repaired[-1:] * 4]) == ""


def test_sensors_that_parts_are_read_without_are_named_once():
    loose = "bogie right: loose from about 8 s on; body: spike of 1 sample (0 s), first at 1 s"
    quality = Quality(
        faults=loose, warnings="parts are read without the sensors of bogie right, body left"
    )
    results = [replace(r, quality=quality) for r in measured()[:2]]
    trips = [r.trip for r in results]
    assert failing_sensors(results) == {
        "bogie right: loose from about 8 s on": trips,
        "body left: not used for the parts": trips,
    }
    assert failing_words(results) == (
        "dead, loose or not used: bogie right, body left (on 2 of the last 2 trips)"
    )


def test_flags_on_all_trips_contradict_nothing(tmp_path):
    """It was "2 of 4 parameters stand out: k_p: no change beyond the spread"."""
    results = [flagged(r, k_p=0.6) for r in measured()]
    _, page = write(tmp_path / "r.html", results)
    assert page.named("div")[0]["class"] == "result act"
    assert "1 of 4 parameters is beyond the act limit:" in page.text
    assert "below the act limit of 80 %; it has been so since the first trips; all" in page.text
    assert "All 12 trips are flagged" in page.text


def test_weaker_side_is_told_above_and_in_the_table(tmp_path):
    words = "primary spring: the left side is weaker (about 20 %)"
    _, page = write(tmp_path / "report.html", [trip(0), trip(1, sides=words, flags=words)])
    assert "Left and right differ on 1 of the last 2 trips; on trip_001: primary" in page.text
    assert (
        page.text.replace("\N{NO-BREAK SPACE}", " ").count(words) == 4
    )  # and as the flag's reason, also on a phone
    assert "\u25d0 Sides" in page.text
    _, page = write(tmp_path / "plain.html", [trip(0)])
    assert "\u25d0" not in page.text


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


def test_one_sentence_for_all_parameters_is_written_once_above_and_once_in_the_table(tmp_path):
    results = [flagged(r) for r in measured()]
    _, page = write(tmp_path / "r.html", results)
    assert page.text.count("not judged, as all trips are flagged") == 2
    assert "k p , c p , k s , c s : not judged, as all trips are flagged" in page.text
    assert page.text.count("as above") >= 3  # no row is without a reason
    assert "within its limits" not in page.text.partition(" Words ")[0]


def test_how_files_were_read_is_a_detail_and_no_fault(tmp_path):
    words = "axle_box.csv: delimiter ';', decimal comma"
    results = [replace(r, quality=replace(r.quality, read_as=words, faults="")) for r in measured()]
    results[3] = replace(results[3], quality=replace(results[3].quality, read_as="other"))
    several = f"{words}; b.csv: delimiter ',', no names; c.csv: delimiter ',', no names"
    results[4] = replace(results[4], quality=replace(results[4].quality, read_as=several))
    details = files_read_as(results)
    words = "delimiter ';', decimal comma"
    assert details == {
        "files read as": f"{words} (11 files) · other (1 trip) · delimiter ',', no names (2 files)"
    }
    assert files_read_as(results[3:4]) == {"files read as": "other"}
    assert files_read_as(measured()) == {}
    text, page = write(tmp_path / "r.html", results, details=details)
    assert page.text.count(words) == 1
    assert text.index("delimiter") > text.index("<h2>Details</h2>")


def test_plus_and_minus_of_the_healthy_values_have_their_level(tmp_path):
    si = {"healthy_si": {"k_p": 1.3e6}, "healthy_half_widths": {"k_p": 0.02}}
    _, page = write(tmp_path / "r.html", measured(**si), level=0.95)
    assert "1300 kN/m ± 2 %" in page.text
    assert "100 % is: ± half of its 95 % interval." in page.text


def test_page_does_not_deny_intervals_that_the_tables_have(tmp_path):
    results = [*measured(5), flagged(measured()[6])]
    _, page = write(tmp_path / "r.html", results)
    assert np.isfinite(results[-1].interval("k_p")).all()
    assert "have no interval" not in page.text
    assert "intervals need not hold the true values and are not shown" in page.text


def test_unknown_remaining_life_says_why(tmp_path):
    text, _ = write(tmp_path / "r.html", measured(3))
    assert '<td class="n life">unknown<small>too few trips (3 of 5)</small></td>' in text


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
    axis.set(ylabel="$k_p$ [% of healthy]", xlabel="mileage [1000 km]", title="trip at 3 000 km")
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


def test_details_are_in_the_language_of_the_page(tmp_path):
    with speaking("de"):
        _, page = write(
            tmp_path / "r.html", measured(), details={"healthy is": "the vehicle file's drawing"}
        )
    assert "gesund ist die Zeichnung der Fahrzeugdatei" in page.text
