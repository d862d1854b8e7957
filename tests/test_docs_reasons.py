"""docs/recordings.md: what it explains is what the programs say, and its tables are complete."""

import re
from pathlib import Path

import pytest

from suspnet.curves.peaks import PeakReason
from suspnet.ground.records import TripResult
from suspnet.trains.recordings.cleaning import KINDS
from suspnet.trains.recordings.formats import READERS
from suspnet.trains.recordings.manifest import MANIFEST
from suspnet.trains.recordings.manifest_sources import CsvDialect, SensorSource, keys_of

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
TEMPLATES = (ROOT / "suspnet" / "ground" / "findings.txt").read_text(encoding="utf-8")


def explained_messages():
    """Return the first cell of each row of the table of messages, without its back-quotes."""
    (block,) = re.findall(r"<!-- reasons -->\n(.*?)<!-- end of reasons -->", PAGE, re.DOTALL)
    rows = [re.fullmatch(r"\| ``(.+?)`` \| .+? \| .+? \|", line) for line in block.splitlines()[2:]]
    assert all(rows)
    return [row[1].strip() for row in rows]


@pytest.mark.parametrize("message", explained_messages())
def test_every_message_that_is_explained_is_one_of_the_programs(message):
    fixed_parts = [re.escape(part.strip()) for part in message.split("…")]
    assert re.search(".*".join(fixed_parts), TEMPLATES)


def test_messages_are_explained_once_and_are_few():
    messages = explained_messages()
    assert 10 < len(messages) == len(set(messages)) <= 30


def test_all_kinds_of_faults_and_of_missing_peaks_are_named():
    for kind in (*KINDS, *(one.name.lower().replace("_", " ") for one in PeakReason if one)):
        assert f"`{kind}`" in PAGE


@pytest.mark.parametrize("keys", [MANIFEST, keys_of(SensorSource), keys_of(CsvDialect)])
def test_tables_of_keys_are_the_schema_of_manifests(keys):
    (table,) = (
        one.splitlines()[2:]
        for one in re.findall(r"(?<=\n\n)\| key \| type .*?(?=\n\n)", PAGE, re.DOTALL)
        if f"| `{next(iter(keys))}` |" in one
    )
    rows = [
        f"| `{name}` | {key.type} | {key.unit} | {key.default} | {key.meaning} |"
        for name, key in keys.items()
    ]
    assert sorted(table) == sorted(row.replace("|  |", "| |") for row in rows)


def test_every_column_of_the_tables_of_trips_is_named():
    columns = TripResult("trip", "trip.yaml").row(("k_p",))
    page = (ROOT / "docs" / "trips.md").read_text(encoding="utf-8")
    page = page.replace(
        "with `_low`, `_high` and `_healthy`",
        "`k_p_n_per_m_low` `k_p_n_per_m_high` `k_p_n_per_m_healthy`",
    )
    assert [name for name in columns if f"`{name}`" not in page] == []


def test_every_suffix_has_a_row():
    (table,) = re.findall(r"^\| suffix .*?\n\n", PAGE, re.DOTALL | re.MULTILINE)
    assert set(re.findall(r"`(\.\w+)`", table)) == set(READERS)
