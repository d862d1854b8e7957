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


@pytest.fixture(scope="session")
def _readings():
    return {}


@pytest.fixture
def records_fitted_once(_readings, monkeypatch):
    """Fit each record once: a check, the training and each evaluation read the healthy ones."""
    from suspnet.trains.identification import rig_records

    fit = rig_records.fit_rig

    def fitted(rig, spectra):
        arrays = spectra.frequencies_hz, spectra.taps, spectra.shares, spectra.noise
        key = rig, spectra.segment_s, *(array.tobytes() for array in arrays)
        if key not in _readings:
            _readings[key] = fit(rig, spectra)
        return _readings[key]

    monkeypatch.setattr(rig_records, "fit_rig", fitted)
