"""From records of a rig to its numbers: commissioning on healthy ones, and later ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from suspnet.curves.speeds import NoEstimateError
from suspnet.estimation.commissioned_rig import (
    CommissionedRig,
    RigEstimate,
    RigReading,
    check_enough,
)
from suspnet.ground.records import INTERVAL_LEVEL
from suspnet.ground.types import BoolArray, FloatArray
from suspnet.ground.wording import ShortRepr
from suspnet.trains.fits.rig_fit import better_order, fit_rig
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import RIG_CHANNELS, RecordManifest, TripManifest
from suspnet.trains.recordings.manifest_files import read_manifest
from suspnet.trains.recordings.recording import load_recording
from suspnet.trains.recordings.sensor import PASS
from suspnet.trains.recordings.sources import open_source
from suspnet.trains.spectra.rig_spectra import RigSpectra
from suspnet.vehicle.rig import Rig

CYCLES, LEAST_CYCLES, SHARE = 40.0, 5.0, 0.125
"""Length of a segment in periods of the rig's first mode, whose peak may be narrower than a bin,
or of less if that is more than this share of the shortest healthy record."""
BETWEEN = {"k_p": "base and frame", "k_s": "frame and body"}
"""What a suspension lies between."""
LITTLE_HZ = 1e-3
"""Frequency up to which times are taken as even while a rate alone is asked for, [Hz]."""
SAME = 0.99
"""Least ratio of the rate of a later record to that which its band needs."""


@dataclass(frozen=True, eq=False, repr=False)
class RigRecord(ShortRepr):
    """Accelerations (3, n) of a rig's base, frame and body, [m/s2], sampled together.

    `usable` (n,) is False where a sensor has a fault; None: nowhere.
    """

    signals: FloatArray
    rate_hz: float
    name: str = "record"
    usable: BoolArray | None = None
    faults: str = ""

    def __post_init__(self) -> None:
        signals = np.asarray(self.signals, dtype=float)
        if signals.ndim != 2 or len(signals) != 3:
            raise ValueError(
                f"`signals` of {self.name} must be base, frame and body, of shape (3, n), got "
                f"{signals.shape}"
            )
        if not np.isfinite(signals).all():
            raise ValueError(f"`signals` of {self.name} hold NaN or infinite values")
        pairs = zip(RIG_CHANNELS, signals, strict=True)
        if constant := [name for name, row in pairs if not np.ptp(row)]:
            raise ValueError(f"{self.name}: {', '.join(constant)} is constant: is a sensor dead?")
        object.__setattr__(self, "signals", signals)


def load_record(manifest: TripManifest | Path | str) -> RigRecord:
    """Return a record by its manifest, cleaned and at the lowest rate of its sensors.

    TripError if the manifest is not that of a rig, or its files cannot be read.
    """
    if not isinstance(manifest, TripManifest):
        manifest = read_manifest(manifest)
    if not isinstance(manifest, RecordManifest):
        raise TripError(f"{manifest.path}: a rig's record is of `format: suspnet-record-1`")
    rates_hz = []
    for name, sensor in manifest.sensors().items():
        with open_source(manifest, sensor, manifest.where(name)) as source:
            next(source.even(LITTLE_HZ))  # the first block of times gives the rate
            rates_hz.append(source.known_rate_hz)
    recording = load_recording(manifest, float(f"{min(rates_hz):.6g}"))
    signals = np.stack([recording.values[name] for name in RIG_CHANNELS])
    faults = "; ".join(map(str, recording.faults))
    return RigRecord(signals, recording.rate_hz, manifest.name, recording.usable, faults)


def reading_of(rig: Rig, records: Sequence[RigRecord]) -> tuple[float, tuple[float, float]]:
    """Return length of segments [s] and band [Hz] in which records of a rig are read.

    NoEstimateError if one is sampled too slowly, or too short.
    """
    low_hz, high_hz = rig.band_hz
    high_hz = min(high_hz, *(PASS * record.rate_hz for record in records))
    if high_hz < rig.modes_hz[0]:
        raise NoEstimateError(
            f"the records show frequencies up to {high_hz:.3g} Hz, a quarter of their rate; the "
            f"first mode of the rig {rig.name} is expected at {rig.modes_hz[0]:.3g} Hz"
        )
    shortest_s = min(record.signals.shape[1] / record.rate_hz for record in records)
    if SHARE * shortest_s * rig.modes_hz[0] < LEAST_CYCLES:
        raise NoEstimateError(
            f"a record of {shortest_s:.3g} s is too short for the first mode of the rig "
            f"{rig.name} at {rig.modes_hz[0]:.3g} Hz: it needs "
            f"{LEAST_CYCLES / SHARE / rig.modes_hz[0]:.3g} s"
        )
    return min(CYCLES / rig.modes_hz[0], SHARE * shortest_s), (low_hz, high_hz)


def commission_rig(rig: Rig, records: Sequence[RigRecord]) -> CommissionedRig:
    """Return a rig as its healthy records show it.

    There must be three, better are five or more, as differently excited as later ones.
    NoEstimateError if one is too short, does not show the suspension, or is sampled too slowly;
    ValueError if there are too few, or the sensors of one look exchanged.
    """
    check_enough(len(records))
    segment_s, band_hz = reading_of(rig, records)
    readings = []
    for record in records:
        try:
            readings.append(read_record(rig, record, segment_s, band_hz))
        except (NoEstimateError, TripError) as reason:
            raise type(reason)(f"{record.name}: {reason}") from reason
    names = tuple(record.name for record in records)
    return CommissionedRig(rig, segment_s, *band_hz, names, tuple(readings))


def read_record(
    rig: Rig, record: RigRecord, segment_s: float, band_hz: tuple[float, float]
) -> RigReading:
    """Return the numbers of a rig from one record alone.

    NoEstimateError if it does not show them, TripError if its sensors look exchanged.
    """
    if PASS * record.rate_hz < SAME * band_hz[1]:
        raise NoEstimateError(
            f"the record is sampled at {record.rate_hz:.4g} Hz; the band up to {band_hz[1]:.3g} "
            f"Hz needs {band_hz[1] / PASS:.4g} Hz"
        )
    spectra = RigSpectra.of(record.signals, record.rate_hz, segment_s, band_hz, record.usable)
    reading = fit_rig(rig, spectra)
    if order := better_order(rig, spectra, reading):
        names = ", ".join(RIG_CHANNELS[i] for i in order)
        raise TripError(f"sensors look exchanged: base, frame and body fit far better as {names}")
    if hidden := [f"{name} (between {BETWEEN[name]})" for name in reading.hides()]:
        raise NoEstimateError(
            f"the record does not show {' and '.join(hidden)}: excite the rig more strongly, "
            "over more frequencies or for longer, and look at the sensors"
        )
    return reading


def read_rig(rig: CommissionedRig, record: RigRecord, level: float = INTERVAL_LEVEL) -> RigEstimate:
    """Return a later record relative to the healthy ones; NoEstimateError if it shows no rig."""
    reading = read_record(rig.rig, record, rig.segment_s, (rig.low_hz, rig.high_hz))
    return rig.estimate(reading, level)
