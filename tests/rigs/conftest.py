"""A commissioned rig that tests share."""

import pytest


@pytest.fixture(scope="session")
def bench():
    """Return numbers of a rig, what is known of it, its healthy records and what they show."""
    from rig_records import numbers, record

    from suspnet import Rig, RigRecord, commission_rig

    true = numbers(20.0, 25.0, 0.8, 0.01, 0.02)
    rig = Rig("bench", primary_hz=26.0, secondary_hz=18.0)
    records = [RigRecord(record(true, 200.0, 24.0, i), 200.0, f"healthy_{i}") for i in range(3)]
    return true, rig, records, commission_rig(rig, records)
