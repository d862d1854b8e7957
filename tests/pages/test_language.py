"""The texts of the pages in German: the catalogue, sentences composed elsewhere, pages."""

import gettext
import pickle
import re
import string
import tomllib
from copy import deepcopy
from pathlib import Path

import pytest

from suspnet.ground.findings import (
    TEMPLATES,
    Finding,
    as_plain,
    of,
    percent,
    restored,
    stored,
    together,
)
from suspnet.ground.parameters import (
    Limits,
)
from suspnet.ground.records import Place
from suspnet.ground.wording import span
from suspnet.runs.language import LANGUAGES, catalogue, check_language, speaking, spoken
from suspnet.trains.fits.worn_parts import WornPart
from suspnet.trains.pages.messages import subject, text
from suspnet.trains.pages.overview import finding
from suspnet.trains.pages.templates import render
from suspnet.trains.recordings.cleaning import Fault

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "suspnet/trains/pages/locale/de/LC_MESSAGES"
PLACEHOLDER = re.compile(r"%\(\w+\)s|%%|%s|\{[^{}]*\}|</?code>|SINCE")
parsed = string.Formatter().parse


@pytest.fixture(scope="module")
def texts():
    """All texts of the package that pages show: of each module and each template."""
    extract = pytest.importorskip("babel.messages.extract")
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["babel"]["mappings"]
    keywords = extract.DEFAULT_KEYWORDS | {"N_": None}
    messages = set()
    for one in options:
        own = {key: value for key, value in one.items() if "_" in key or key == "trimmed"}
        name = one["pattern"].rpartition("/")[2].replace("**", "*")
        for path in (ROOT / "suspnet").rglob(name):
            if path.suffix != ".py" or re.search(rb"gettext\(|N_\(", path.read_bytes()):
                several = extract.extract_from_file(one["method"], path, keywords, (), own)
                messages |= {message for _, message, *_ in several}
    return messages


@pytest.fixture(scope="module")
def german():
    """The catalogue as its translators edit it, by the text that is translated."""
    pofile = pytest.importorskip("babel.messages.pofile")
    with (FOLDER / "suspnet.po").open("rb") as stream:
        found = pofile.read_po(stream, locale="de")
    return {one.id: one for one in found if one.id}


def forms(message):
    return message if isinstance(message, tuple | list) else (message,)


def test_no_text_lacks_its_german(texts, german):
    assert len(texts) > 300
    assert texts == set(german)
    for one in german.values():
        assert all(forms(one.string)), f"no German for {one.id!r}"
        assert not one.fuzzy, f"not checked yet: {one.id!r}"


def test_german_has_the_placeholders_of_the_english(german):
    for one in german.values():
        for english, said in zip(forms(one.id), forms(one.string), strict=True):
            names = sorted(PLACEHOLDER.findall(english))
            assert sorted(PLACEHOLDER.findall(said)) == names, one.id
            assert '"' not in said, "it would end an attribute"
            assert not re.search(r"<(?!/?code>)", said)


def test_compiled_catalogue_is_current(german):
    compiled = catalogue("de")
    assert isinstance(compiled, gettext.GNUTranslations)
    for one in german.values():
        if isinstance(one.id, tuple):
            assert tuple(compiled.ngettext(*one.id, n) for n in (1, 2)) == tuple(one.string)
        else:
            assert compiled.gettext(one.id) == one.string
    texts_of = {key[0] if isinstance(key, tuple) else key for key in compiled._catalog}
    assert texts_of - {""} == {forms(one)[0] for one in german}


@pytest.mark.parametrize("file", sorted(ROOT.glob("suspnet/**/*.html")), ids=lambda one: one.name)
def test_template_has_no_text_outside_the_catalogue(file):
    page = re.sub(r"\{#.*?#\}", "", file.read_text(encoding="utf-8"), flags=re.S)
    page = re.sub(r"\{% trans.*?\{% endtrans %\}", "", page, flags=re.S)
    page = re.sub(r"\{\{.*?\}\}|\{%.*?%\}", "", page, flags=re.S)
    attributes = re.findall(r'(?:aria-label|alt|title|placeholder)="([^"]*)"', page)
    words = re.findall(r"[^\W\d_]{2,}", " ".join([*attributes, re.sub(r"<[^>]*>", " ", page)]))
    assert set(words) <= {"suspnet", "km", "nbsp"}
    for columns in re.findall(r"\{% set columns = (.*?) %\}", file.read_text(encoding="utf-8")):
        without = re.sub(r'_\("[^"]*"\)', "", columns)
        assert not re.findall(r"""["']#?[A-Z][a-z][^"']*["']""", without)


LAST = Finding(
    "last-trip-beyond",
    level=Finding("level", percent=percent(62.1, 1)),
    beyond=Finding("below-act-limit", limit=70.0),
)
UNITS = Finding("one-of", allowed=["g"])
SAID = {
    together((LAST, Finding("fell", percent=38.0, km=12_000.0))): (
        "die letzte Fahrt liegt bei 62,1 % des Referenzwerts, unter der Eingriffsgrenze von 70 %; "
        "sank um 38 % bei etwa 12 000 km"
    ),
    finding(
        [{"severity": "act"}, {"severity": "act"}, {"severity": "none"}]
    ): "3 Federungen: 2 mit Eingriff, 1 ohne Alarm.",
    Finding("alarm-since", words=Finding("fell", percent=3.5, km=12_000.0), km=14_000.0): "sank um "
    "3,5 % bei etwa 12 000 km (Alarm seit 14 000 km)",
    of(
        "a.yaml", Finding("not-so", key="`unit`", rule=Finding("one-of", allowed=["g"]), got="'k'")
    ): ("a.yaml: `unit`: verlangt ist eines von ['g'], angegeben ist 'k'"),
    span("2015-08-03", "2016-02-07"): "03.08.2015 bis 07.02.2016",
    Finding(
        "work-at-visit", what="replace", day="2026-03-15"
    ): "beim Termin am 15.03.2026 tauschen",
    WornPart(("k_s_left", "c_s_left"), 41.0, 0.831).finding: "Sekundärfeder links oder "
    "Sekundärdämpfer links bei 83,1 % des Referenzwerts (Quote 41 : 1; welches davon, ist "
    "unbekannt)",
    together(
        ("within its limits", Finding("reference-incomplete", n_trips=2, needed=20))
    ): "innerhalb der Grenzen; bisher 2 von 20 Fahrten für die Referenz",
    str(Place("air spring 3", "leading", "left", "ICE 4", "7")): "Zug ICE 4, Wagen 7, "
    "air spring 3, vorderes Drehgestell, links",
    str(Fault("body", "spike", 12, 1170.0, 3.1, True)): "Wagenkasten: Spitze über 12 Abtastwerte "
    "(1,17e+03 s), zuerst bei 3,100 s, repariert",
    str(Fault("axle_box axle2 left", "gap", 1, 0.002, 3.1, False)): "Achslagergehäuse der Achse 2, "
    "links: Lücke über 1 Abtastwert (0,002 s), zuerst bei 3,100 s, nicht nutzbar",
    str(Limits((0.8, 1.2), (0.7, 1.25))): "Warnung außerhalb von 80 bis 120 %, Eingriff außerhalb "
    "von 70 bis 125 %",
    "body_left": "Wagenkasten, links",
    "act": "Eingriff",
    "62.1": "62,1",
}


@pytest.mark.parametrize("english", SAID, ids=str)
def test_findings_are_german(english):
    with speaking("de"):
        assert spoken(english) == SAID[english]
    with speaking("en"):
        assert spoken(str(english)) == spoken(english)


def test_sensors_are_in_words():
    assert spoken("axle_box axle1 left") == "axle box of axle 1, left"
    assert spoken("bogie axle2 right") == "bogie frame of axle 2, right"
    assert spoken("body") == "body"  # alone, it may be anything
    assert (
        spoken(of("body", "gap; give `bogie: leading`")) == "car body: gap; give `bogie: leading`"
    )


def test_every_kind_is_german_and_says_what_its_values_are():
    english = r"\b(?:the|is|are|and|or|of|to|that|with|which|its|not|at|by|from|for)\b"
    for kind, forms_of_kind in TEMPLATES.items():
        places = [place for form in forms_of_kind for place in parsed(form)]
        fields = {name: spec for _, name, spec, _ in places if name}
        values = {name: 2.0 if spec else f"Qz{i}" for i, (name, spec) in enumerate(fields.items())}
        values |= {"n": 2} if "n" in fields else {}
        with speaking("de"):
            text = spoken(Finding(kind, **values))
        assert not re.search(english, re.sub(r"`[^`]*`|\S+=\S+", "", text)), kind
        assert all(value in text for value in values.values() if isinstance(value, str)), kind


@pytest.mark.parametrize(
    "text", ["3.5 % at 3 km", "{0}", "%(x)s", "<script>", '{"kind": "act"}', '{"kind": [[', ""]
)
def test_a_text_of_users_stays_as_it_is(text):
    with speaking("de"):
        assert spoken(text) == text
        assert spoken(of(text, text)) == f"{text}: {text}"
    assert restored(stored(text)) in (text, "")


def test_a_finding_survives_stores_and_processes():
    found = of("trip", together((LAST, "as it was said before"), "; "))
    for again in (restored(stored(found)), pickle.loads(pickle.dumps(found)), deepcopy(found)):
        assert again == found
        assert again.plain() == found.plain()
    with pytest.raises(AttributeError, match="does not change"):
        found.kind = "list"
    unknown = stored(found).replace('"kind": "last-trip-beyond"', '"kind": "of-the-future"')
    assert restored(unknown) == found
    assert str(ValueError(found)) is found


def test_language_ends_with_its_block():
    with speaking("de"), pytest.raises(RuntimeError, match="inside"):
        raise RuntimeError("inside")
    assert spoken("left") == "left"
    with pytest.raises(ValueError, match="must be one of en, de, got 'fr'"):
        check_language("fr")
    assert set(LANGUAGES) == {"en", "de"}


def test_page_of_a_file_is_german_and_escapes_what_it_is_given():
    values = {"rows": [], "parameters": ("k_p",), "finding": finding([{"severity": "unknown"}])}
    values |= dict.fromkeys(("most_severe", "plan", "bogies"), "")
    values |= {"n_bogies": 0, "address": None}
    with speaking("de"):
        page = render("fleet.html", **values)
        assert '<html lang="de">' in page
        assert "1 Federung: 1 nicht bewertet." in page
        assert "Zuletzt bei" in page
        evil = render("fleet.html", **values | {"finding": of("<script>", "act")})
        assert "&lt;script&gt;: Eingriff" in evil
    assert '<html lang="en">' in render("fleet.html", **values)


def test_mails_are_german():
    alarm = {
        "severity": "act",
        "vehicle": "am96",
        "place": str(Place("", "leading", "left", "12", "3")),
        "parameter": "k_s",
        "cause": "limit",
        "begin_km": 56_000.0,
        "end_km": None,
        "state": "new",
        "acknowledged_by": "Kim",
        "reason": str(LAST),
        "findings": as_plain(LAST),
    }
    content = {"kind": "digest", "day": "2026-11-25", "alarms": [alarm], "n_suspensions": 4}
    with speaking("de"):
        assert subject(content) == "suspnet 25.11.2026: 1 aktiver Alarm, 1 mit Eingriff"
        lines = text(content | {"id": "abc"}).splitlines()
        at_once = subject(content | {"kind": "alarm", "alarms": [alarm, alarm]})
    assert lines == [
        "Neu:",
        "- Eingriff: am96: Zug 12, Wagen 3, vorderes Drehgestell, links: k_s (Grenze), seit "
        "56 000 km: die letzte Fahrt liegt bei 62,1 % des Referenzwerts, unter der Eingriffsgrenze "
        "von 70 %; quittiert von Kim",
        "",
        "4 Federungen in der Historie.",
        "Nachricht abc",
    ]
    place = "am96: Zug 12, Wagen 3, vorderes Drehgestell, links: k_s"
    assert at_once == f"suspnet: Eingriff: {place} und 1 weitere"
