"""docs/recordings.md and trips.md: their tables hold every key, kind, column and suffix."""

import re
from pathlib import Path

import pytest

from suspnet.ground.records import TripResult
from suspnet.recordings.cleaning import KINDS
from suspnet.recordings.formats import READERS
from suspnet.recordings.manifest import MANIFEST
from suspnet.recordings.manifest_keys import CsvDialect, keys_of
from suspnet.recordings.manifest_sources import Channel
from suspnet.spectra.peaks import PeakReason

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
REASONS = [
    reason.strip()
    for block in re.findall(r"<!-- reasons -->\n(.*?)<!-- end of reasons -->", PAGE, re.DOTALL)
    for reason in re.findall(r"^\| ``(.+?)`` \|", block, re.MULTILINE)
]


def test_no_reason_stands_twice_and_there_are_many():
    assert len(REASONS) == len(set(REASONS)) > 100


def test_all_kinds_of_faults_and_of_missing_peaks_are_named():
    for kind in KINDS:
        assert any(f": {kind} " in reason for reason in REASONS), kind
    for reason in PeakReason:
        assert not reason or f"`{reason.name.lower().replace('_', ' ')}`" in PAGE


@pytest.mark.parametrize("keys", [MANIFEST, keys_of(Channel), keys_of(CsvDialect)])
def test_tables_of_keys_are_the_schema_of_manifests(keys):
    (table,) = (
        one.splitlines()[2:]
        for one in re.findall(r"(?<=\n\n)\| key \| type .*?(?=\n\n)", PAGE, re.DOTALL)
        if f"| `{next(iter(keys))}` |" in one
    )
    assert sorted(table) == sorted(key.row(name) for name, key in keys.items())


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
