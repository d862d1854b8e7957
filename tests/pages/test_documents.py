"""Tables as XLSX and pages as PDF, opened again."""

import math
from datetime import datetime

import pytest
from served_fleet import FAILED, WORN, trips

from suspnet.trains.pages.output import check_documents, write_documents
from suspnet.trains.pages.overview import Evaluated
from suspnet.trains.pages.pdf import as_pdf
from suspnet.trains.pages.xlsx import header_of, write_xlsx

openpyxl = pytest.importorskip("openpyxl")
pytest.importorskip("xlsxwriter")
START = "2026-03-01T06:00:00+02:00"
FORMULAS = ("=1+1", "=cmd|' /C calc'!A0", "+1", "@SUM(A1)", "\t=1", "{=1}", "https://x.example")
MARKUP = ("<r>...</r>", "<r><t>1</t></r>", "<r>&</r>", "<r></r>", "_x0041_")


def sheet_of(tmp_path, rows):
    found = write_xlsx({"trips": rows, "none": []}, tmp_path / "tables.xlsx")
    book = openpyxl.load_workbook(found)
    assert book.sheetnames == ["trips"]
    return book["trips"]


def test_numbers_times_and_truths_have_types(tmp_path):
    row = {"trip": "007", "mileage_km": 2000.5, "n": 3, "ok": True, "start": START}
    sheet = sheet_of(tmp_path, [row, {"trip": "8", "mileage_km": math.nan, "start": "soon"}])
    assert [cell.value for cell in sheet[1]] == ["trip", "mileage_km [km]", "n", "ok", "start"]
    assert [cell.value for cell in sheet[2]] == ["007", 2000.5, 3, True, datetime(2026, 3, 1, 4)]
    assert sheet["E2"].is_date
    assert [cell.value for cell in sheet[3]] == ["8", None, None, None, "soon"]


@pytest.mark.parametrize("text", [*FORMULAS, *MARKUP])
def test_texts_are_never_formulas_links_or_markup(tmp_path, text):
    sheet = sheet_of(tmp_path, [{"trip": text, text: 1.0}])
    cell = sheet["A2"]
    assert cell.data_type == sheet["B1"].data_type == "s"
    assert cell.hyperlink is None
    assert cell.value.endswith(text.strip())


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        *((t, t) for t in ("1850-01-01", "0001-01-01T00:00:00+14:00", "9999-12-31T23:00:00-14:00")),
        ("a\x07b", "a\\x07b"),
    ],
)
def test_times_that_a_spreadsheet_cannot_hold_and_controls_are_texts(tmp_path, text, shown):
    assert sheet_of(tmp_path, [{"trip": "1", "start": text}])["B2"].value == shown


@pytest.mark.parametrize(
    ("name", "header"),
    [
        ("c_s", "c_s [1]"),
        ("c_s_low", "c_s_low [1]"),
        ("c_p_axle1_left", "c_p_axle1_left [1]"),
        ("k_s_n_per_m_high", "k_s_n_per_m_high [N/m]"),
        ("c_p_ns_per_m_healthy", "c_p_ns_per_m_healthy [N s/m]"),
        ("speed_m_per_s", "speed_m_per_s [m/s]"),
        ("duration_s", "duration_s [s]"),
        ("coherence_s", "coherence_s [1]"),
        ("n_averages", "n_averages"),
    ],
)
def test_headers_have_units(name, header):
    assert header_of(name) == header


def test_page_is_printed_without_loading_anything(tmp_path):
    pdfium = pytest.importorskip("pypdfium2")
    pytest.importorskip("weasyprint")
    secret = tmp_path / "secret.txt"
    secret.write_text("never printed")
    links = f'<link rel="attachment" href="{secret.as_uri()}"><img src="http://127.0.0.1:9/x.png">'
    content = as_pdf(f"<html><head>{links}</head><body><p>Report &lt;b&gt;</p></body></html>")
    assert b"/EmbeddedFile" not in content
    document = pdfium.PdfDocument(content)
    words = document[0].get_textpage().get_text_range()
    document.close()
    assert words.startswith("Report <b>")


def test_documents_of_a_folder_stand_next_to_its_pages(tmp_path):
    pytest.importorskip("weasyprint")
    results = trips(FAILED, n_trips=3)
    done = [Evaluated("a", FAILED, results), Evaluated("b", WORN, error="no manifest")]
    for page in ("overview.html", "a/report.html"):
        (tmp_path / page).parent.mkdir(exist_ok=True)
        (tmp_path / page).write_text("<html><body>page</body></html>")
    write_documents(done, tmp_path, pdf=True, xlsx=True)
    assert {one.name for one in tmp_path.rglob("*.pdf")} == {"overview.pdf", "report.pdf"}
    book = openpyxl.load_workbook(tmp_path / "tables.xlsx")
    assert [book[name].max_row for name in book.sheetnames] == [3, 4]
    head = [cell.value for cell in book["trips"][1]]
    column = head.index("k_s [1]")
    values = [row[column].value for row in list(book["trips"].rows)[1:]]
    assert values == pytest.approx([one.estimates["k_s"] for one in results], rel=1e-14)


def test_missing_packages_are_named_before_anything_is_read(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"weasyprint is missing: pip install ..\[pdf\]"):
        check_documents(pdf=True, xlsx=False)
    with pytest.raises(ValueError, match=r"xlsxwriter is missing: pip install ..\[xlsx\]"):
        check_documents(pdf=False, xlsx=True)
