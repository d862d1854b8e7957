"""The texts of the pages in German: the catalogue, sentences composed elsewhere, pages."""

import gettext
import re
import string
import tomllib
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from suspnet.ground.parameters import (
    BOGIE_PARTS,
    DEFAULT_LIMITS,
    KIND_NAMES,
    Cause,
    Limits,
    limits_words,
    part_words,
    read_limits,
)
from suspnet.ground.records import Place
from suspnet.report.language import LANGUAGES, best_of, catalogue, check_language, speaking
from suspnet.report.messages import subject, text
from suspnet.report.sentences import PATTERNS, spoken
from suspnet.report.templates import LABELS, render
from suspnet.trips.check_page import READY, TripCheck, write_checks

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "suspnet/report/locale/de/LC_MESSAGES"
PLACEHOLDER = re.compile(r"%\(\w+\)s|%%|%s|\{\w*\}|</?code>|SINCE")


@pytest.fixture(scope="module")
def texts():
    """All texts of the package that pages show: of each module and each template."""
    extract = pytest.importorskip("babel.messages.extract")
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["babel"]["mappings"]
    methods = [(one["pattern"], one["method"]) for one in options]
    known = {
        one["pattern"]: {k: v for k, v in one.items() if "_" in k or k == "trimmed"}
        for one in options
    }
    keywords = extract.DEFAULT_KEYWORDS | {"N_": None}
    found = extract.extract_from_dir(ROOT / "suspnet", methods, known, keywords)
    return {(name, message) for name, _, message, *_ in found}


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
    wanted = {message for _, message in texts}
    assert len(wanted) > 300
    assert wanted == set(german)
    for one in german.values():
        assert all(forms(one.string)), f"no German for {one.id!r}"
        assert not one.fuzzy, f"not checked yet: {one.id!r}"


def test_german_has_the_placeholders_of_the_english(german):
    for one in german.values():
        english = sorted(PLACEHOLDER.findall(forms(one.id)[-1]))
        for said in forms(one.string):
            assert sorted(PLACEHOLDER.findall(said)) == english, one.id
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


@pytest.mark.parametrize("file", sorted(ROOT.glob("suspnet/*/*.html")), ids=lambda one: one.name)
def test_template_has_no_text_outside_the_catalogue(file):
    page = re.sub(r"\{#.*?#\}", "", file.read_text(encoding="utf-8"), flags=re.S)
    page = re.sub(r"\{% trans.*?\{% endtrans %\}", "", page, flags=re.S)
    page = re.sub(r"\{\{.*?\}\}|\{%.*?%\}", "", page, flags=re.S)
    attributes = re.findall(r'(?:aria-label|alt|title|placeholder)="([^"]*)"', page)
    words = re.findall(r"[^\W\d_]{2,}", " ".join([*attributes, re.sub(r"<[^>]*>", " ", page)]))
    assert set(words) <= {"suspnet", "km", "nbsp"}


@pytest.mark.parametrize("file", sorted(ROOT.glob("suspnet/*/*.html")), ids=lambda one: one.name)
def test_template_has_no_english_in_its_columns_and_labels(file):
    page = file.read_text(encoding="utf-8")
    for columns in re.findall(r"\{% set columns = (.*?) %\}", page):
        without = re.sub(r'_\("[^"]*"\)', "", columns)
        assert not re.findall(r"""["']#?[A-Z][a-z][^"']*["']""", without)


def test_sentences_are_german():
    said = {
        "the last trip is at 62.1 % of healthy, below the act limit of 70 %; falls to 62 % of "
        "healthy (median of the last 5 trips), steadily along the mileage": "die letzte Fahrt "
        "liegt bei 62,1 % des Referenzwerts, unter der Eingriffsgrenze von 70 %; sinkt auf 62 % "
        "des Referenzwerts (Median der letzten 5 Fahrten), stetig über der Laufleistung",
        "4 suspensions: 2 to act on, 1 without alarm.": "4 Federungen: 2 mit Eingriff, "
        "1 ohne Alarm.",
        "fell by 3.5 % at about 12 000 km (alarm since 14 000 km); within its limits": "sank um "
        "3,5 % bei etwa 12 000 km (Alarm seit 14 000 km); innerhalb der Grenzen",
        "`channels.body.unit` must be one of ['m/s2', 'g'], got 'mm/s2'; give ['g']": "`channels."
        "body.unit`: verlangt ist eines von ['m/s2', 'g'], angegeben ist 'mm/s2'; ['g'] angeben",
        "2015-08-03 to 2016-02-07": "03.08.2015 bis 07.02.2016",
        "replace at the visit of 2026-03-15": "beim Termin am 15.03.2026 tauschen",
        "12: the newest trip is 3 922 days old (2026-02-26). The wear since then is unknown, so "
        "that only parts with an alarm have a visit, to inspect them. Evaluate newer trips, or "
        "give today=2026-02-27 for the plan of that time. 1 visit with 1 job until 2038-11-22, 0 "
        "parts may need work later, 1 needs nothing..": "12: Die neueste Fahrt "
        "ist 3 922 Tage alt (26.02.2026). Der Verschleiß seither ist unbekannt; deshalb haben nur "
        "Teile mit einem Alarm einen Termin, zur Prüfung. Neuere Fahrten auswerten, oder "
        "today=2026-02-27 angeben für den Plan von damals. 1 Termin mit 1 Arbeit bis 22.11.2038, 0 "
        "Teile brauchen vielleicht später Arbeit, 1 braucht nichts..",
        "worn, odds over 1000 : 1": "verschlissen, Quote über 1000 : 1",
        "Worn parts on 3 of the last 5 trips; on trip_039: damper of axle 1, left at 62 % of "
        "healthy (odds over 1000 : 1); secondary spring, left or secondary damper, left at 83.1 % "
        "of healthy (odds 41 : 1, which of them is not known).": "Verschlissene Teile auf 3 der "
        "letzten 5 Fahrten; auf trip_039: Primärdämpfer, Achse 1 links bei 62 % des Referenzwerts "
        "(Quote über 1000 : 1); Sekundärfeder links oder Sekundärdämpfer links bei 83,1 % des "
        "Referenzwerts (Quote 41 : 1; welches davon, ist unbekannt).",
        "damping of the primary damper, axle 2, left": "Dämpfung des Primärdämpfers, Achse 2, "
        "links",
        "secondary spring, left or secondary spring, right": "Sekundärfeder links oder "
        "Sekundärfeder rechts",
        "c_s, k_s: the last trip is at 150 % of healthy; the last 2 trips are above the act limit "
        "of 125 %; the change began at about 75 000 km": "c_s, k_s: die letzte Fahrt liegt bei "
        "150 % des Referenzwerts; die letzten 2 Fahrten liegen über der Eingriffsgrenze von 125 %; "
        "die Änderung begann bei etwa 75 000 km",
        "within its limits; alarms of changes not armed yet: 2 of 20 trips for the reference so "
        "far": "innerhalb der Grenzen; Änderungsalarme noch nicht scharf: bisher 2 von 20 Fahrten "
        "für die Referenz",
        "Plan of 2026-03-01: 0 visits, 0 jobs until 2028-02-29, 4 parts unknown": "Instandhaltungs"
        "plan vom 01.03.2026: 0 Termine, 0 Arbeiten bis 29.02.2028, 4 Teile unbekannt",
        "not read: only 7 averages, 20 are needed": "nicht gelesen: nur 7 Mittelungen, nötig sind "
        "20",
        str(Place("air spring 3", "leading", "left", "ICE 4", "7")): "Zug ICE 4, Wagen 7, "
        "air spring 3, vorderes Drehgestell, links",
    }
    for english, german in said.items():
        with speaking("de"):
            assert spoken(english) == german
        assert spoken(english) == english


def test_sensors_are_in_words():
    said = {
        "body: spike of 12 samples (1.17e+03 s), first at 3.1 s, repaired; bogie right: loose from "
        "about 183 s on: it shows nothing there of the motion that the others show, and that part "
        "is left out; check its cable and connector": "Wagenkasten: Spitze über 12 Abtastwerte "
        "(1,17e+03 s), zuerst bei 3,1 s, repariert; Drehgestellrahmen, rechts: lose ab etwa 183 s: "
        "zeigt dort nichts von der Bewegung, die die anderen zeigen; dieser Teil bleibt "
        "unberücksichtigt; Kabel und Stecker prüfen",
        "axle_box axle2 left": "Achslagergehäuse der Achse 2, links",
        "axle_box: spike of 1 sample (0.002 s), first at 3.1 s, repaired": "Achslagergehäuse: "
        "Spitze über 1 Abtastwert (0,002 s), zuerst bei 3,1 s, repariert",
    }
    for english, german in said.items():
        with speaking("de"):
            assert spoken(english) == german
    assert spoken("axle_box: gap; see axle_box left") == "axle box: gap; see axle box, left"
    assert spoken("bogie axle2 right") == "bogie frame of axle 2, right"
    assert spoken("body: gap; give `bogie: leading`") == "car body: gap; give `bogie: leading`"


def test_every_name_of_a_part_is_german():
    names = [*KIND_NAMES.values(), *map(part_words, BOGIE_PARTS), *map(str, Cause)]
    names.remove(str(Cause.SENSOR))  # the same word but for its capital
    with speaking("de"):
        for name in names:
            assert not set(spoken(name).split()) & set(name.replace(",", "").split()) - {"1", "2"}
        for _, label in LABELS.values():
            assert spoken(label) != label or catalogue("de").gettext(label) != label


def test_what_is_wrong_with_trips_is_german():
    """All of the tables of docs/recordings.md."""
    page = (ROOT / "docs/recordings.md").read_text(encoding="utf-8")
    blocks = re.findall(r"<!-- reasons -->\n(.*?)<!-- end of reasons -->", page, re.DOTALL)
    reasons = re.findall(r"^\| ``(.+?)`` \|", "".join(blocks), re.MULTILINE)
    assert len(reasons) > 200
    english = r"\b(?:the|is|are|and|or|of|to|that|with|which|its|not|at|by|from|for)\b"
    with speaking("de"):
        for reason in reasons:
            said = re.sub(r"`[^`]*`|\S+=\S+", "", spoken(reason.strip()))
            assert not re.search(english, said), said


@given(st.sampled_from(PATTERNS), st.text(max_size=300))
def test_any_text_is_said_without_error_and_what_is_unknown_stays(pattern, value):
    fields = [name for _, name, _, _ in string.Formatter().parse(pattern) if name]
    with speaking("de"):
        spoken(pattern.format(**dict.fromkeys(fields, value)))
        for mark in ("{0}", "%(x)s", "<script>"):
            assert mark in spoken(f"{mark} at 3 km")


def test_long_texts_of_users_cost_no_time():
    with speaking("de"):
        long = "1 part unknown, " + " with until, " * 150
        assert spoken(long) == long
        assert len(spoken(", with until" * 60)) > 600


def test_language_ends_with_its_block():
    with speaking("de"), pytest.raises(RuntimeError, match="inside"):
        raise RuntimeError("inside")
    assert spoken("left") == "left"
    with pytest.raises(ValueError, match="must be one of en, de, got 'fr'"):
        check_language("fr")
    assert best_of(["fr-FR", "de-CH", "en"]) == "de"
    assert best_of([]) == "en"
    assert set(LANGUAGES) == {"en", "de"}


def test_page_of_a_file_is_german_and_escapes_what_it_is_given():
    values = {"rows": [], "outputs": ("k_p",), "finding": "1 suspension: 1 not judged."}
    values |= {"most_severe": "", "bogies": [], "n_bogies": 0}
    with speaking("de"):
        page = render("overview.html", **values)
        assert '<html lang="de">' in page
        assert "1 Federung: 1 nicht bewertet." in page
        assert "Zuletzt bei" in page
        evil = render("overview.html", **values | {"finding": "<script> at 3 km"})
        assert "&lt;script&gt; bei 3 km" in evil
    assert '<html lang="en">' in render("overview.html", **values)


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
        "reason": "the last trip is at 62.1 % of healthy, below the act limit of 70 %",
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


def test_files_read_as_and_titles_of_figures_are_german():
    with speaking("de"):
        assert spoken("rows from line 10 on (16 files)") == "Werte ab Zeile 10 (16 Dateien)"
        assert spoken("hollow: trips without an estimate") == "hohl: Fahrten ohne Schätzung"
        assert spoken("% of nominal") == "% des Nennwerts"


def test_page_of_a_check_is_german_and_its_data_are_english(tmp_path):
    bad = TripCheck(Path("a.yaml"), problems=("bogie: clock jumps by +15 ms against that of body",))
    dead = "body: dead and left out: it is constant (0) throughout: is the sensor connected?"
    good = TripCheck(
        Path("b.yaml"),
        READY,
        remarks=(dead,),
        vehicle="am96",
        place=Place("S1", "leading"),
        sensors="single sensors",
    )
    with speaking("de"):
        page = write_checks([bad, good], ["there is no file or folder x"], tmp_path).read_text()
    for said in (
        "1 von 2 Fahrten bereit für eine Schätzung, 1 mit Problemen",
        "es gibt weder Datei noch Ordner x",
        "am96, S1, vorderes Drehgestell: 1 von 1 Fahrt bereit; eine Inbetriebnahme braucht 3",
        "Wagenkasten: tot und weggelassen: durchweg konstant (0): Ist der Sensor angeschlossen?",
        "einzelne Sensoren",
    ):
        assert said in page.replace("\N{NO-BREAK SPACE}", " ")
    content = (tmp_path / "check.json").read_text()
    assert dead in content
    assert "bereit" not in content


def test_details_of_reports_are_german():
    said = {
        "msvr, trained on 2000 curves of VerticalVehicle": "msvr, trainiert auf 2000 Kurven von "
        "VerticalVehicle",
        "observer, hann windows of 20 s": "observer, hann-Fenster von 20 s",
        "what 5 trips from 1000 to 5000 km showed, damping at 20 °C": "was 5 Fahrten von 1000 bis "
        "5000 km zeigten, Dämpfung bei 20 °C",
        "1.07 times the noise with each part read, 1.20 times the noise with both sides and axles "
        "as equal": "das 1,07-Fache des Rauschens, wenn jedes Teil einzeln geschätzt wird, das "
        "1,20-Fache des Rauschens mit beiden Seiten und Achsen als gleich",
        str(
            Limits((0.8, 1.2), (0.7, 1.25))
        ): "Warnung außerhalb von 80 bis 120 %, Eingriff außerhalb von 70 bis 125 %",
        "armed by 20 trips, at most one false alarm in 2 000 000 km": "scharf durch 20 Fahrten, "
        "höchstens ein Fehlalarm in 2 000 000 km",
        "fleet.db: the store is damaged (bad header); put a copy in its place, or evaluate the "
        "trips again into a new one": "fleet.db: der Speicher ist beschädigt (bad header); eine "
        "Kopie an seine Stelle setzen oder die Fahrten neu in einen neuen auswerten",
    }
    with speaking("de"):
        assert {one: spoken(one) for one in said} == said
        limits = read_limits(
            yaml.safe_load((ROOT / "configs/vehicle/am96.yaml").read_text())["limits"]
        )
        for one in (limits, DEFAULT_LIMITS, DEFAULT_LIMITS | limits):
            words = spoken(limits_words(one))
            assert words.count("Warnung außerhalb von 90 bis 110 %, Eingriff außerhalb von") >= 1
            assert not re.search(r"\b(beyond|assumed|a|spring|than|its)\b", words), words
