"""The report is one file that stands alone, shows every trip and escapes what it is given."""

import base64
import re
from dataclasses import replace
from html import unescape
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.figure import Figure
from trip_records import OUTPUTS, fleet, trip

from suspnet.monitoring import figures, health_figure, report
from suspnet.monitoring.trend import trend

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


def trends_of(results):
    mileage = [r.mileage_km for r in results]
    return [
        trend(name, mileage, [r.estimates.get(name, np.nan) for r in results]) for name in OUTPUTS
    ]


def small_figure():
    figure = Figure(figsize=(2, 2))
    figure.subplots().plot([1, 2])
    return figure


def write(path, results, drawn=None, details=None, title="Suspension report"):
    drawn = {"trend": small_figure()} if drawn is None else drawn
    details = {"model": "msvr"} if details is None else details
    report.write_report(path, title, results, OUTPUTS, drawn, trends_of(results), details)
    text = path.read_text(encoding="utf-8")
    return text, Page(text)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a report with all figures: its text, page and trips."""
    results = fleet()
    drawn = {
        "quality": figures.quality(results),
        "signals": figures.trip_signals(results[-1]),
        "extra_figure": small_figure(),
        "responses": figures.trip_responses(results),
        "trend": health_figure.health_trend(results, OUTPUTS),
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
    assert "2 of 4 parameters stand out:" in words
    for one in trends_of(results):
        assert one.verdict in words
    assert words.count("▲ falls") == 2


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
    fields = {"trip": HOSTILE, "vehicle": HOSTILE, "suspension": HOSTILE, "start": HOSTILE}
    results = [
        trip(0, quality=quality, **fields),
        trip(1, missing=True, **(fields | {"reason": HOSTILE})),
    ]
    drawn = {HOSTILE: small_figure(), "signals": figures.trip_signals(results[0])}
    text, page = write(tmp_path / "r.html", results, drawn, {HOSTILE: HOSTILE}, HOSTILE)
    assert page.named("script") == []
    assert "<script" not in text.lower()
    assert unescape(text).count("alert('x')") > 10
    assert "{{ 7 * 7 }}" in page.text
    assert "49" not in page.named("img")[0]["alt"]


@pytest.mark.parametrize(
    ("results", "sentence"),
    [
        ([trip()], "too few trips with an estimate to tell"),
        ([trip(i, missing=True) for i in range(3)], "too few trips with an estimate to tell"),
        ([], "too few trips with an estimate to tell"),
        ([trip(i) for i in range(12)], "Nothing stands out: no parameter changed"),
        (
            [trip(i) if i > 4 else trip(i, estimates={"k_p": 1.0}) for i in range(12)],
            "some parameters have too few trips to tell",
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
