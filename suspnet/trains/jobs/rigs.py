"""Rigs from folders of records: commissioning, later records, tables and what is printed."""

from __future__ import annotations

import csv
import io
import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

from suspnet.curves.speeds import NoEstimateError
from suspnet.estimation.commissioned_rig import (
    ABSOLUTE,
    RATIOS,
    CommissionedRig,
    RigEstimate,
    Value,
)
from suspnet.estimation.rig_files import save_rig
from suspnet.ground.parameters import PARAMETERS, Severity
from suspnet.ground.progress import bar
from suspnet.ground.records import ERROR, INTERVAL_LEVEL, NO_ESTIMATE, OK
from suspnet.ground.storage import printable, write_atomically, write_json
from suspnet.ground.tensors import threads
from suspnet.trains.identification.rig_records import commission_rig, loaded, read_record
from suspnet.trains.recordings.errors import TripError
from suspnet.trains.recordings.manifest import RecordManifest
from suspnet.trains.recordings.manifest_files import ManifestFile, find_manifests, is_of_rig
from suspnet.vehicle.rig import Rig

log = logging.getLogger(__name__)
WIDEST = 10.0
"""Ratio of the ends of an interval from which a table shows none: the record does not tell."""
SHOWN = {
    "primary_hz": "frame alone, Hz",
    "secondary_hz": "body alone, Hz",
    "primary_damping": "damping of the frame alone",
    "secondary_damping": "damping of the body alone",
    "mass_ratio": "body over frame, mass",
}
"""Names of the numbers of a rig in tables."""
NOT_SHOWN = "-"
"""Cell of a number that a record does not show."""
READS = (*PARAMETERS, "k_s_over_M_s")
"""Ratios that tables show."""


@dataclass(frozen=True)
class RigResult:
    """One record of a folder: its estimate, or the reason why there is none."""

    record: str
    status: str
    start: datetime | None = None
    reason: str = ""
    faults: str = ""
    estimate: RigEstimate | None = None

    @property
    def severity(self) -> Severity:
        """How urgent it is."""
        return Severity.UNKNOWN if self.estimate is None else self.estimate.severity

    def row(self) -> dict[str, Any]:
        """Return the row of records.csv."""
        row: dict[str, Any] = {
            "record": self.record,
            "start": "" if self.start is None else self.start.isoformat(),
            "status": self.status,
            "verdict": str(self.severity),
            "reason": self.reason,
            "faults": self.faults,
        }
        if self.estimate is None:
            return row
        numbers = {**self.estimate.ratios, **self.estimate.values}
        for name in (*RATIOS, *ABSOLUTE):
            value = numbers[name]
            row |= {name: value.value, f"{name}_low": value.low, f"{name}_high": value.high}
        return row | {"misfit": self.estimate.bare_misfit}


def holds_records(folder: Path) -> bool:
    """Return whether the first manifest of a folder is of a rig's record.

    FileNotFoundError if the folder holds no manifest; a manifest that cannot be read is of none.
    """
    if not folder.is_dir() or not any(folder.glob("*.yaml")):
        return False
    try:
        return is_of_rig(ManifestFile(find_manifests(folder)[0]).content)
    except TripError:
        return False


def records_of(folder: Path, rig: str) -> list[RecordManifest]:
    """Return the manifests of a folder by start, or by name where one has none.

    TripError with all problems if one is wrong or of another rig.
    """
    manifests: list[RecordManifest] = []
    problems: list[str] = []
    for path in find_manifests(folder):
        try:
            manifests.append(_of_rig(path, rig))
        except TripError as error:
            problems += error.problems
    if problems:
        raise TripError(*problems)
    if any(manifest.start is None for manifest in manifests):
        return manifests
    return sorted(manifests, key=lambda manifest: (str(manifest.start), manifest.name))


def _of_rig(path: Path, rig: str) -> RecordManifest:
    manifest = ManifestFile(path).trip
    if not isinstance(manifest, RecordManifest):
        raise TripError(f"{path}: the manifest is of a train's trip, the rig {rig} reads records")
    if manifest.vehicle != rig:
        raise TripError(f"{path}: the record is of {manifest.vehicle!r}, the rig is {rig!r}")
    return manifest


@threads(1)
def commission_folder(
    rig: Rig, folder: Path, output: Path, n_healthy: int | None = None
) -> CommissionedRig:
    """Return a rig as the first records of a folder show it, and write it to `output`.

    `n_healthy` None is all. TripError and NoEstimateError name the record that is wrong.
    """
    records = [loaded(manifest) for manifest in records_of(folder, rig.name)[:n_healthy]]
    commissioned = commission_rig(rig, records)
    save_rig(output, commissioned)
    write_json(output / "commissioning.json", summary_of(commissioned))
    return commissioned


def summary_of(rig: CommissionedRig) -> dict[str, Any]:
    """Return what healthy records show of a rig, as JSON-able values."""
    values = {name: asdict(value) for name, value in rig.healthy().items()}
    masses = {} if rig.rig.bogie_mass_kg is None else _si(rig, rig.rig.bogie_mass_kg)
    return {
        "rig": rig.rig.name,
        "records": list(rig.records),
        "low_hz": rig.low_hz,
        "high_hz": rig.high_hz,
        "segment_s": rig.segment_s,
        "misfit": rig.misfit,
        "error": rig.error,
        "level": INTERVAL_LEVEL,
        "healthy": values,
        "healthy_si": masses,
        "errors": np.mean([r.errors for r in rig.readings], axis=0).tolist(),
    }


def _si(rig: CommissionedRig, bogie_mass_kg: float) -> dict[str, float]:
    values = bogie_mass_kg * np.exp(rig.logs)
    return dict(zip(PARAMETERS, values.tolist(), strict=True))


def commissioning_lines(rig: CommissionedRig) -> list[str]:
    """Return what healthy records show of a rig, as lines."""
    healthy = rig.healthy()
    rows = [[words, *_parts(healthy[name])] for name, words in SHOWN.items()]
    level = f"{100 * INTERVAL_LEVEL:g} % interval"
    return [
        f"{rig.rig.name}: {len(rig.readings)} healthy records, {rig.low_hz:.3g} to "
        f"{rig.high_hz:.3g} Hz in segments of {rig.segment_s:.3g} s",
        *tabulate(rows, ["", "healthy", level], disable_numparse=True).splitlines(),
        f"two masses on springs leave {rig.misfit:.3g} times the noise unexplained, "
        f"{100 * rig.error:.2g} % of the signals (median over frequency), which counts as noise",
    ]


@threads(1)
def read_folder(
    rig: CommissionedRig, folder: Path, output: Path, level: float = INTERVAL_LEVEL
) -> list[RigResult]:
    """Read all records of a folder; write records.csv and records.json.

    A record that cannot be read has the reason, and harms no other. FileNotFoundError if the
    folder holds no manifest.
    """
    results = []
    paths = find_manifests(folder)
    for path in bar("records", len(paths), items=paths, unit="record"):
        results.append(_result(rig, path, level))
    if all(result.start is not None for result in results):
        results.sort(key=lambda result: (str(result.start), result.record))
    rows = [result.row() for result in results]
    text = io.StringIO()
    columns = dict.fromkeys(name for row in rows for name in row)
    table = csv.DictWriter(text, list(columns), lineterminator="\n")
    table.writeheader()
    table.writerows(rows)
    write_atomically(output / "records.csv", text.getvalue())
    write_json(
        output / "records.json",
        {"rig": rig.rig.name, "level": level, "healthy": summary_of(rig), "records": rows},
    )
    return results


def _result(rig: CommissionedRig, path: Path, level: float) -> RigResult:
    result = RigResult(path.stem, ERROR)
    try:
        manifest = _of_rig(path, rig.rig.name)
        record = loaded(manifest)
        result = replace(result, start=manifest.start, faults=record.faults)
        reading = read_record(rig.rig, record, rig.segment_s, (rig.low_hz, rig.high_hz))
    except NoEstimateError as reason:
        return replace(result, status=NO_ESTIMATE, reason=str(reason))
    except TripError as error:
        return replace(result, reason="; ".join(error.problems))
    except Exception as error:  # one faulty record must not hide the others
        log.debug("record %s failed", path, exc_info=True)
        return replace(result, reason=f"{type(error).__name__}: {error}")
    # a record that is one of the healthy ones is compared with the others
    for i, healthy in enumerate(rig.readings):
        if rig.records[i] == record.name and np.allclose(healthy.logs, reading.logs, atol=1e-6):
            return replace(result, status=OK, estimate=rig.estimate_healthy(i, level))
    return replace(result, status=OK, estimate=rig.estimate(reading, level))


def reading_lines(rig: CommissionedRig, results: Sequence[RigResult], level: float) -> list[str]:
    """Return what records show, as lines: a table in % of healthy, then what is beyond limits."""
    rows, notes = [], []
    for result in results:
        if result.estimate is None:
            notes.append(f"{result.record}: no estimate: {result.reason}")
            continue
        ratios = result.estimate.ratios
        cells = [_percent(ratios[name]) for name in READS]
        rows.append([result.record, *cells, str(result.severity)])
        if beyond := _beyond(result.estimate):
            notes.append(f"{result.record}: {result.severity}: {beyond}")
    titles = [name.replace("_over_", "/") for name in READS]
    head = f"in % of healthy, {100 * level:g} % intervals; {NOT_SHOWN}: the record does not show it"
    table = tabulate(rows, ["record", *titles, "verdict"], disable_numparse=True)
    healthy = f"{rig.rig.name}: {head}"
    return [printable(line) for line in (healthy, *table.splitlines(), *notes)]


def _beyond(estimate: RigEstimate) -> str:
    return ", ".join(
        f"{name} at {_percent(estimate.ratios[name])} % of healthy"
        for name, severity in estimate.severities.items()
        if severity >= Severity.NOTICE
    )


def _parts(value: Value) -> tuple[str, str]:
    if value.high > WIDEST * value.low:
        return f"{value.value:.3g}", NOT_SHOWN
    number, low, high = _texts(value)
    return number, f"{low} to {high}"


def _percent(ratio: Value) -> str:
    if ratio.high > WIDEST * ratio.low:
        return NOT_SHOWN
    value, low, high = _texts(Value(100 * ratio.value, 100 * ratio.low, 100 * ratio.high))
    return f"{value} ({low} to {high})"


def _texts(value: Value) -> list[str]:
    """Return a number and the ends of its interval with as many digits as that is worth."""
    digits = max(3, 1 - math.floor(math.log10(max(value.high / value.low - 1, 1e-5))))
    return [f"{end:.{digits}g}" for end in (value.value, value.low, value.high)]
