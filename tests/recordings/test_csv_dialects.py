"""CSV files as loggers write them: the dialect is detected, or the error says what to give."""

import re
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_files import opened

from suspnet.trains.recordings import csv_dialect, csv_files
from suspnet.trains.recordings.csv_dialect import find_dialect
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.formats import open_columns, open_file, read_columns
from suspnet.trains.recordings.manifest_sources import CsvDialect, SensorSource

ROWS = np.array([[0.0, 1.5, -0.25], [0.1, -2.5, 1e-5], [0.2, np.nan, 12.0], [0.3, 4.0, 0.125]])


def written(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "data.csv"
    path.write_text(text, encoding, newline="")
    return path


def read(path: Path, *columns, csv: CsvDialect | None = None) -> list[np.ndarray]:
    blocks = list(open_columns(path, columns, csv))
    return [np.concatenate(parts) for parts in zip(*blocks, strict=True)]


def table(delimiter=",", decimal=".", head=("t,a,b",), end="\n", empty="") -> str:
    """Return rows as a logger would write them; names are parted as the rows are."""
    cell = [
        [empty if np.isnan(x) else repr(x).replace(".", decimal) for x in row]
        for row in ROWS.tolist()
    ]
    lines = [line.replace(",", delimiter) for line in head]
    return end.join([*lines, *(delimiter.join(row) for row in cell), ""])


# --- reference: the same numbers whatever the dialect ------------------------------------------


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "latin-1"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize(
    ("delimiter", "decimal"),
    [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("|", "."), ("  ", ".")],
)
@pytest.mark.parametrize(
    "head",
    [["t,a,b"], ["Gerät 7", "Rate [Hz],1000", "", "t,a,b"], ["Größe,3,2.5", "t,a,b", "s,m/s2,g"]],
)
def test_numbers_are_those_written(tmp_path, delimiter, decimal, encoding, end, head):
    path = tmp_path / "data.csv"
    text = table(delimiter, decimal, head, end, empty="NaN" if delimiter == "  " else "")
    path.write_bytes(text.encode(encoding))
    got = read(path, "b", "t", "a")
    np.testing.assert_array_equal(got, ROWS[:, [2, 0, 1]].T)
    with open_file(path) as file:
        units = [column.unit for column in file.columns]
        assert units == (["s", "m/s2", "g"] if "s,m/s2,g" in head else [None] * 3)
        assert f"names in line {head.index('t,a,b') + 1}," in file.words
        assert f"decimal sign {decimal!r}" in file.words


def test_detected_dialect_is_named(tmp_path):
    text = "\n".join(["Prüfer;7", "", "Zeit;a [g];", "0,5;1,25;", "1,0;2,5;"])
    path = written(tmp_path, text, "utf-16")
    with open_file(path) as file:
        assert file.words == (
            "data.csv: delimiter ';', decimal sign ',', names in line 3, rows from line 4 on, "
            "utf-16"
        )
        assert [column.name for column in file.columns] == ["Zeit", "a [g]", "column_3"]
        assert file.column("a [g]").unit == "g"


@pytest.mark.parametrize(
    ("text", "columns", "expected"),
    [
        ("a\n0,5\n1,5\n", ["a"], [[0.5, 1.5]]),
        ("t,a\n0,5\n1,5\n", ["a"], [[5, 5]]),
        ('"t","a"\n"0,5","1,5"\n"0,6","2,5"\n', ["t", "a"], [[0.5, 0.6], [1.5, 2.5]]),
        ("1.5;2.5\n3.5;4.5\n", ["column_2"], [[2.5, 4.5]]),
        ("# t a\n0 1\n1 2\n", ["a"], [[1, 2]]),
        ("t;state;a\n0;OK;1\n1;3D fix;2\n2;;3\n", ["a"], [[1, 2, 3]]),
        ("t,a\n---,---\n0,1\n1,2\n", ["a"], [[1, 2]]),
        ("x;1;2\nt;a;b\n0;1;2\n1;2;3\n", ["b"], [[2, 3]]),
        ("a\nnan\ninf\n-inf\n", ["a"], [[np.nan, np.inf, -np.inf]]),
        ("t,a\n0,-\n1,***\n2,NULL\n3,4\n", ["a"], [[np.nan] * 3 + [4]]),
        ("   t    a\n 0.5    1\n10.5   -2\n", ["t", "a"], [[0.5, 10.5], [1, -2]]),
        ("\ufefft,a\n0,1\n", ["t"], [[0]]),
        ("t,a\r0,1\r1,2\r", ["a"], [[1, 2]]),
        ("1\n2\n3\n", [None], [[1, 2, 3]]),
    ],
)
def test_small_files_are_read_as_they_are_meant(tmp_path, text, columns, expected):
    np.testing.assert_array_equal(read(written(tmp_path, text), *columns), expected)


@pytest.mark.parametrize(
    ("text", "expected", "zoned"),
    [
        ("t,a\n2015-08-03T08:00:00Z,1\n2015-08-03T08:00:01Z,2\n", 0, True),
        ("t,a\n2015-08-03 08:00:00.250,1\n2015-08-03 08:00:00.5,2\n", 0.25, False),
        ("t;a\n2015-08-03T10:00:00,5+02:00;1,5\n2015-08-03T10:00:01,5+02:00;2,5\n", 0.5, True),
        ("t\ta\n2015-08-03T13:30:00+0530\t1\n\t2\n", 0, True),
    ],
)
def test_time_stamps_are_read(tmp_path, text, expected, zoned):
    path = written(tmp_path, text)
    (times, _) = read(path, "t", None)
    begin = np.datetime64("2015-08-03T08:00:00", "ns")
    assert (times[0] - begin) / np.timedelta64(1, "s") == expected
    with open_file(path) as file:
        assert (file.column("t").is_time, file.column("t").is_zoned) == (True, zoned)


def test_blocks_of_any_size_give_the_same(tmp_path, monkeypatch):
    rng = np.random.default_rng(0)
    values = rng.standard_normal((4000, 2))
    path = tmp_path / "data.csv"
    path.write_text("\n".join(["t  a", *(f" {x!r}   {y!r}  " for x, y in values.tolist())]))
    monkeypatch.setattr(csv_files, "BLOCK_BYTES", 501)
    np.testing.assert_array_equal(read(path, "t", "a"), values.T)
    path.write_text(path.read_text(), "utf-16")
    np.testing.assert_array_equal(read(path, "t", "a"), values.T)


def test_only_the_beginning_is_read_to_find_out(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_dialect, "SAMPLE_BYTES", 2**10)
    path = written(tmp_path, "t;a\n" + "0,5;1,5\n" * 9999)
    assert find_dialect(path).decimal == ","
    assert len(read(path, "a")[0]) == 9999


# --- property ------------------------------------------------------------------------------------


@given(
    st.lists(st.tuples(*[st.floats(allow_nan=False, allow_infinity=False)] * 2), min_size=2),
    st.sampled_from([(";", ","), ("\t", ","), (",", "."), (";", "."), ("|", ",")]),
    st.sampled_from(["utf-8", "utf-16", "utf-8-sig"]),
    st.integers(0, 3),
)
def test_every_number_is_kept(tmp_path_factory, rows, dialect, encoding, n_lines):
    delimiter, decimal = dialect
    path = tmp_path_factory.mktemp("csv") / "data.csv"
    cells = [delimiter.join(repr(x).replace(".", decimal) for x in row) for row in rows]
    lines = [*(f"about line {i}" for i in range(n_lines)), f"t{delimiter}a", *cells]
    path.write_text("\n".join(lines), encoding)
    try:
        got = read(path, "t", "a")
    except TripError as error:
        assert "a comma may be its decimal sign" in str(error)  # noqa: PT017
        got = read(path, "t", "a", csv=CsvDialect(decimal=decimal))
    np.testing.assert_array_equal(got, np.transpose(rows))


def test_a_german_logger_with_columns_of_date_and_clock_says_start_and_decimal_sign(tmp_path):
    path = tmp_path / "gps.csv"
    rows = "".join(f"03.08.2015;06:20:{i:02d},000;252,000\n" for i in range(9))
    path.write_text("Datum;Uhrzeit;Geschwindigkeit [km/h]\n" + rows)
    found = find_dialect(path)
    assert (found.decimal, found.date) == (",", "03.08.2015 06:20:00,000")
    np.testing.assert_array_equal(read(path, "Geschwindigkeit [km/h]")[0], np.full(9, 252.0))
    path.write_text("n;Datum;a\n" + "1;03/08/2015 06:20;0,5\n" * 9)  # March or August?
    assert find_dialect(path).date is None


# --- failure -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "reason", "given", "expected"),
    [
        ("0,5\n1,5\n", "has no names and may be read with", CsvDialect(delimiter=","), [5, 5]),
        (
            "a;b\n1,234;5\n2,345;6\n",
            "a comma may be its decimal sign or separate thousands",
            CsvDialect(decimal=","),
            [1.234, 2.345],
        ),
        (
            "n;a\n1;-345\n2;1.036\n3;-12.500\n",
            "a point may be its decimal sign or separate thousands",
            CsvDialect(decimal="."),
            [1, 2, 3],
        ),
        (
            "Time (s) Accel (g)\n0 1.5\n1 2.5\n",
            "no row has as many values as there are names",
            CsvDialect(header_line=0),
            [0, 1],
        ),
    ],
)
def test_ambiguous_files_are_refused_until_told(tmp_path, text, reason, given, expected):
    path = written(tmp_path, text)
    message = rf"data\.csv: .*{reason}.*; say how it is written in the manifest.*`csv: \{{delimi"
    with pytest.raises(TripError, match=message) as caught:
        read(path, "a")
    assert "\n" not in str(caught.value)
    name = find_dialect(path, given).names[0 if len(expected) != 2 or expected != [5, 5] else 1]
    np.testing.assert_array_equal(read(path, name, csv=given)[0], expected)


@pytest.mark.parametrize(
    ("text", "given", "message"),
    [
        ("only words\n" * 9, None, "no row of numbers was found"),
        ("t,a\n", None, "no row of numbers was found: it is empty"),
        ("t;a\n0;1\n", CsvDialect(delimiter=","), "no row of numbers was found"),
        ("t;a\n0;1\n", CsvDialect(encoding="utf-16"), "it is not utf-16 text"),
        ("t;a\n0;1\n", CsvDialect(header_line=7), "no row of numbers was found"),
    ],
)
def test_files_that_are_no_table_are_refused(tmp_path, text, given, message):
    path = written(tmp_path, text)
    with pytest.raises(TripError, match=rf"data\.csv: {message}"):
        read(path, "a", csv=given)


@pytest.mark.parametrize("line", ["\t" * 80_000, ',"' * 60_000, ' "' * 59_999])
def test_a_long_line_above_the_names_takes_no_long_time(tmp_path, line):
    path = written(tmp_path, f"{line}\nt;a\n" + "0;1\n" * 50)
    begin = time.process_time()
    assert len(read(path, "a")[0]) == 50
    assert time.process_time() - begin < 2


@pytest.mark.parametrize("cell", ["-1,193.18", "-1.193,18", "1'193", "1.193.180", "1\xa0193,18"])
@pytest.mark.parametrize("is_most", [False, True])
@pytest.mark.parametrize("decimal", [".", ","])
def test_grouped_digits_are_refused(tmp_path, cell, is_most, decimal):
    path = tmp_path / "data.csv"
    others = [f"{i}{decimal}5" for i in range(30)]
    rows = [[one, other] for other in others for one in ([cell] if is_most else [other] * 3)]
    rows.insert(9, [cell, others[0]])
    path.write_text("t;a\n" + "".join(f"{b};{a}\n" for a, b in rows), "utf-8")
    otherwise = "|has no column 't' of numbers" if is_most else ""  # split at the comma
    with pytest.raises(
        TripError, match=f"write numbers without separators of thousands{otherwise}"
    ):
        read(path, "t", "a")


@pytest.mark.parametrize("cells", ["0;12.345;13.346", "1.000;2.345", "345;1036;0.125", "7;0.125"])
def test_a_point_of_three_decimals_is_a_decimal_sign(tmp_path, cells):
    path = tmp_path / "data.csv"
    path.write_text("n;a\n" + "".join(f"{i};{cell}\n" for i, cell in enumerate(cells.split(";"))))
    np.testing.assert_array_equal(read(path, "a")[0], [float(cell) for cell in cells.split(";")])


@pytest.mark.parametrize("delimiter", ",;\t")
@pytest.mark.parametrize(
    ("line", "n_samples"),
    [
        *(("# marker", 0), ("Pause", 0), ("a,b", 0), ("# a,b", 0)),
        *(("ERR,off", 1), (",", 1), ("0.5", 1), ("0.5,1,2", 1)),
    ],
)
def test_damaged_rows_are_samples_and_other_lines_are_not(tmp_path, line, n_samples, delimiter):
    path = tmp_path / "data.csv"
    rows = [f"{i}.25,{i}.5" for i in range(40)]
    lines = ["a,b", *rows[:20], line, *rows[20:]]
    path.write_text("\n".join(lines).replace(",", delimiter))
    values = np.insert(np.arange(40) + 0.5, 20, [np.nan] * n_samples)
    np.testing.assert_array_equal(read(path, "b")[0], values)


@pytest.mark.parametrize("names", ["t,b,a", "# t,b,a", "Time [s],x,y", "t,speed,a"])
def test_several_tables_are_refused(tmp_path, names):
    path = tmp_path / "data.csv"
    table = "".join(f"{i},1.5,2.5\n" for i in range(40))
    path.write_text(f"t,a,b\n{table}{names}\n{table}")
    message = rf"data\.csv: holds several tables .line 42: '{re.escape(names)}'.; export each"
    with pytest.raises(TripError, match=message):
        read(path, "t", "a")


def test_later_rows_of_another_dialect_are_refused(tmp_path):
    path = written(tmp_path, "t;a\n" + "0;1\n" * 80_000 + "0,5;1,5\n")
    message = r"text in a column of numbers.*line 80002.*'0,5'.*decimal sign is taken to be '\.'"
    with pytest.raises(TripError, match=message):
        read(path, "t")
    path.write_text("t;a\n" + "2015-08-03T08:00:00;1\n" * 20_000 + "2015-08-03T08:00:00Z;1\n")
    with pytest.raises(TripError, match="a time stamp is not like the first"):
        read(path, "t", "a")


def test_dialects_are_for_csv_files(tmp_path):
    np.save(tmp_path / "data.npy", ROWS)
    (tmp_path / "data.npy").rename(tmp_path / "data.mat")
    with pytest.raises(TripError, match=r"`csv` is for files of type \['\.csv', '\.txt'"):
        read(tmp_path / "data.mat", "a", csv=CsvDialect(decimal=","))


@pytest.mark.parametrize("wrong", ["31.08.2015 23:5x:58", "31.08.2015 \xe4"])
def test_a_row_without_its_time_is_none(tmp_path, wrong):
    path = tmp_path / "data.csv"
    lines = [f"31.08.2015 23:59:{second};1" for second in range(10, 59)]
    path.write_text("\n".join(["t;a", *lines[:40], f"{wrong};1", *lines[40:]]), "utf-8")
    with open_file(path) as file:
        blocks = list(read_columns(path, file, ["t", "a"]))
        assert re.search("are missing samples .1, first in line 42: '3", file.remarks[0])
    times, values = (np.concatenate(part) for part in zip(*blocks, strict=True))
    assert np.flatnonzero(np.isnat(times)) == np.flatnonzero(np.isnan(values)) == 40
    lines[40] = "31.09.2015 23:59:50;1"  # no date: its value has no time
    path.write_text("\n".join(["t;a", *lines]))
    assert np.flatnonzero(np.isnat(read(path, "t", "a")[0])) == 40
    path.write_text("\n".join(["t;a", *lines, "31/08/2015 23:59:59;1"]))
    with pytest.raises(TripError, match=r"a time stamp is not like the first .line 51: '31/08"):
        read(path, "t", "a")


# files as people have them


def rows(form, n=30) -> str:
    """Return n rows of a table: a time, in a form of milliseconds, and i + 0.5."""
    return "".join(f"{form(5 * i)},{i}.5\n" for i in range(n))


TABLE = rows(lambda ms: f"{ms / 1000:.3f}")
STATED = {
    "a word in the first row": (
        "t,a\n-1,ERR\n" + TABLE,
        "words .* are missing .1, first in line 2: '-1,ERR'",
    ),
    "a word in the third row": (
        f"t,a\n-3,7\n-2,8\n-1,over range\n{TABLE}",
        "words in place .* are missing .1, first in line 4: '-1,over range'",
    ),
    "words in all pieces": (
        "t,a\n" + TABLE.replace("9.5\n", "9.5\n,bad\n"),
        "damaged rows of data.csv are missing samples .2, first in line 12: ',bad'",
    ),
    "a minus sign": ("t,a\n\N{MINUS SIGN}1,\N{MINUS SIGN}3\n" + TABLE, ""),
    "infinity": ("t,a\n-1,\N{INFINITY}\n" + TABLE, ""),
    "infinity of C": ("t,a\n-1,-1.#INF\n" + TABLE, ""),
    "names and a second line of them": ("Time,Acc\nvertical,raw\n" + TABLE, "names in line 1"),
    "names, units, descriptions": ("Time,Acc\n[s],[g]\nlogger,axle box\n" + TABLE, "in line 1"),
    "names, descriptions, units": ("Time,Acc\nlogger,axle box\ns,g\n" + TABLE, "in line 1"),
    "names, units, sensitivities": ("t,a\ns,g\nScale,100.2\n" + TABLE, "in line 1"),
    "metadata of as many cells": ("Operator,Smith\nt,a\n" + TABLE, "names in line 2"),
    "a cut last line": (
        f"t,a\n{TABLE}0.9",
        "lines .* outside of its table are .* .1, first in line 32: '0.9'",
    ),
    "zero bytes": ("t,a\n" + TABLE + "\0" * 3000, r"zero bytes in data.csv are left out \(3000\)"),
    "a footer": (f"t,a\n{TABLE}\nEnd of file\n", ".1, first in line 33: 'End of file'"),
    "a footer with numbers": (
        f"t,a\n{TABLE}Rows,30\nMax; t,29.5\n",
        "lines .* are left out .2, first in line 32: 'Rows,30'",
    ),
    "names again": (
        f"t,a\n{TABLE}t,a\n{TABLE}",
        "lines .* are left out .1, first in line 32: 't,a'",
    ),
}


@pytest.mark.parametrize("block", [200, 2**19])
@pytest.mark.parametrize("case", STATED)
def test_good_rows_are_read_and_the_rest_is_reported(tmp_path, monkeypatch, case, block):
    monkeypatch.setattr(csv_files, "BLOCK_BYTES", block)
    text, remark = STATED[case]
    path = written(tmp_path, text, "utf-8")
    with open_file(path) as file:
        names = [column.name for column in file.columns]
        parts = list(read_columns(path, file, names))
        times, values = (np.concatenate(part) for part in zip(*parts, strict=True))
        assert re.search(remark, "; ".join([file.words, *file.remarks]))
    known = np.isfinite(values) & (times >= 0)
    n = len(TABLE.splitlines())
    np.testing.assert_array_equal(values[known][:n], np.arange(n) + 0.5)
    np.testing.assert_array_equal(times[known][:n], np.arange(n) * 5 / 1000)
    assert np.count_nonzero(known) == (2 * n if case == "names again" else n)
    if "infinity" in case or "word in the first" in case:
        assert not np.isfinite(values[0])
    if case == "a minus sign":
        assert (times[0], values[0]) == (-1, -3)


def test_a_name_too_few_is_refused(tmp_path):
    (tmp_path / "data.csv").write_text("t,a\n" + "".join(f"{i},1,{2 * i}\n" for i in range(30)))
    with pytest.raises(TripError, match="no row has as many values as there are names"):
        find_dialect(tmp_path / "data.csv")


def clock(ms: int) -> str:
    return f"08:00:00.{ms:03d}"


@pytest.mark.parametrize(
    ("form", "begin"),
    [
        (lambda ms: f"2026/08/03 {clock(ms)}", "2026-08-03T08"),
        (lambda ms: f"2026-08-03 {clock(ms)} +02:00", "2026-08-03T06"),
        (lambda ms: f"2026-08-03 08:00:00:{ms:03d}", "2026-08-03T08"),
        (lambda ms: f"2026-08-03 {clock(ms)} UTC", "2026-08-03T08"),
        (lambda ms: f"08/23/2026 {clock(ms)} PM", "2026-08-23T20"),
        (lambda ms: f"23/08/2026 {clock(ms)}", "2026-08-23T08"),
        (lambda ms: f"3-Aug-26 {clock(ms)[1:]}", "2026-08-03T08"),
        (lambda ms: f"3. August 2026 {clock(ms)}", "2026-08-03T08"),
        (lambda ms: f"{clock(ms)[1:].rstrip('0')} am".replace(". ", " "), "1900-01-01T08"),
        (lambda ms: f"08:00:00:{ms:03d}", "1900-01-01T08"),
        (lambda ms: f"00:00.{ms:03d}", "1900-01-01T00"),
        (lambda ms: f"08/03/2026 {clock(ms)}", "1900-01-01T08"),
    ],
)
def test_time_stamps_of_all_notations_are_read(tmp_path, form, begin):
    path = written(tmp_path, "t,a\n" + rows(form))
    with open_file(path) as file:
        assert ("as day and month are unclear" in file.words) == (form(0)[:5] == "08/03")
        assert file.column("t").is_time
    (times, _) = read(path, "t", "a")
    steps = (5 * np.arange(30)).astype("timedelta64[ms]")
    np.testing.assert_array_equal(times, np.datetime64(begin, "ns") + steps)


def test_times_of_day_take_the_date_of_the_header(tmp_path):
    path = written(tmp_path, "Datum: 03.08.2026\nt,a\n" + rows(clock))
    assert read(path, "t")[0][0] == np.datetime64("2026-08-03T08:00:00", "ns")


@pytest.mark.parametrize("form", [lambda ms: f"day 3, {ms} ticks", lambda ms: f"08h00m{ms}"])
def test_times_that_are_not_understood_are_named(tmp_path, form):
    path = written(tmp_path, "t;a\n" + rows(lambda ms: form(ms) + ";").replace(";,", ";"))
    with open_file(path) as file:
        assert f"the times of 't', like {form(75)!r}, cannot be read" in file.words
    message = (
        rf"column 't' holds text like '{form(75)}', neither numbers nor times that can be read"
    )
    with pytest.raises(TripError, match=message):
        read(path, "t", "a")
    message = f"here needs `rate_hz` or `time` .*; 't' holds text like '{form(75)}'"
    with pytest.raises(TripError, match=message), opened(path, SensorSource(path.name, "g", "a")):
        pass


def test_a_file_that_is_mostly_something_else_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_dialect, "SAMPLE_BYTES", 2**10)
    path = written(tmp_path, "t,a\n" + TABLE * 10 + "some other text, of three, cells\n" * 60)
    message = "60 lines are no rows of its table .first in line 302: 'some other text"
    with pytest.raises(TripError, match=message):
        read(path, "t", "a")
