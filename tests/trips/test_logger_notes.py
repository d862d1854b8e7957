"""What loggers write about a trip: names in German and English, numbers of both kinds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import needed

from suspnet.trains.recordings.formats import open_file
from suspnet.trains.recordings.reader_server import MOST_NOTES
from suspnet.trains.trips.file_contents import Stated, key_of, read_value, stated_in


def values(*lines):
    return {key: note.value for key, note in stated_in(lines).items()}


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("Kilometerstand;123.456,7;km", {"mileage_km": 123456.7}),
        ('"Kilometerstand [km]"\t"123456,7"', {"mileage_km": 123456.7}),
        ("# Laufleistung = 51.333 km", {"mileage_km": 51333.0}),
        ("km-Stand: 51333.25", {"mileage_km": 51333.25}),
        ("Mileage: 123,456.7 km", {"mileage_km": 123456.7}),
        ("Odometer,51.333", {"mileage_km": 51.333}),
        ("Odometer;51,333", {"mileage_km": 51333.0}),
        ("Kilometerstand;1'234'567", {"mileage_km": 1234567.0}),
        ("Kilometerstand;unbekannt", {}),
        ("Fahrzeug;am96", {"vehicle": "am96"}),
        ("Fahrzeugtyp: BR 412", {"vehicle": "BR 412"}),
        ("Drehgestell;4711", {"suspension": "4711"}),
        ("Drehgestell: vorn", {"bogie": "leading"}),
        ("bogie: trailing", {"bogie": "trailing"}),
        ("Fahrtrichtung;rückwärts", {"direction": "reverse"}),
        ("Richtung: Köln - Frankfurt", {}),
        ("Seite;rechts", {"side": "right"}),
        ("Temperatur;-3,5 °C", {"temperature_c": -3.5}),
        ("Raddurchmesser;920 mm", {"wheel_diameter_m": 0.92}),
        ("Geschwindigkeit: 252,5 km/h", {"speed": "252.5 km/h"}),
        ("Datum;03.08.2015", {"start": "2015-08-03T00:00:00"}),
        ("Messgerät;Logger 7", {}),
        ("Fahrzeug;", {}),
        ("", {}),
        ("Fahrzeug;" + 300 * "x", {}),
    ],
)
def test_lines_state_keys_of_a_manifest(line, expected):
    assert values(line) == expected


def test_first_line_of_a_key_counts_and_is_the_source():
    found = stated_in(["Fahrzeug;a", "vehicle: b"])
    assert found == {"vehicle": Stated("a", "by the line 'Fahrzeug'")}


@given(st.integers(0, 2 * 10**7), st.integers(0, 9))
def test_grouped_numbers_of_both_languages_are_one_number(whole, tenths):
    english = f"{whole:,}.{tenths}"
    german = english.translate(str.maketrans(",.", ".,"))
    expected = whole + tenths / 10
    assert values(f"Mileage: {english} km") == {"mileage_km": expected}
    assert values(f"Kilometerstand;{german} km") == {"mileage_km": expected}
    assert values(f"Kilometerstand: {whole:,}".replace(",", ".")) == {"mileage_km": float(whole)}


@pytest.mark.parametrize(
    "text", ["\0", "=:;", ":" * 60, "start:\t\ud800", "km [: 1e999", "Datum;;,"]
)
def test_no_line_is_an_error(text):
    assert all(isinstance(note.value, str | float) for note in stated_in([text, text * 4]).values())


def test_names_of_columns_are_known_without_their_units():
    assert key_of("Kilometerstand [km]") == key_of("km_Stand") == "mileage_km"
    assert key_of("v GPS [km/h]") == ""
    assert read_value("start", "Datum", "gestern") is None


def test_properties_of_a_tdms_file_are_limited_in_number_and_length(tmp_path):
    nptdms = needed("nptdms")
    properties = {"Fahrzeug": "am96", "comment": 10**6 * "x"}
    properties |= {f"note {i}": "." for i in range(2 * MOST_NOTES)}
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        root, channel = nptdms.RootObject(properties), nptdms.ChannelObject("g", "a", np.ones(9))
        writer.write_segment([root, channel])
    with open_file(tmp_path / "a.tdms") as file:
        assert len(file.notes) == MOST_NOTES
        assert sum(map(len, file.notes)) < 10**5
        assert stated_in(file.notes)["vehicle"].value == "am96"
