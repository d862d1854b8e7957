"""Rigs from folders of records: commissioning, later records, tables and what is printed."""

import logging
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
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
from suspnet.ground.storage import printable, write_json, write_table
from suspnet.ground.tensors import threads
from suspnet.trains.identification.rig_records import commission_rig, load_record, read_record
from suspnet.trains.recordings.errors import TripError, all_of
from suspnet.trains.recordings.manifest import RecordManifest
from suspnet.trains.recordings.manifest_files import ManifestFile, find_manifests, is_of_rig
from suspnet.vehicle.rig import Rig

log = logging.getLogger(__name__)
WIDEST = 10.0
"""Ratio of the ends of an interval from which a table shows none: the record does not show it."""
SHOWN = {
    "primary_hz": "frame alone, Hz",
    "secondary_hz": "body alone, Hz",
    "primary_damping": "damping of the frame alone",
    "secondary_damping": "damping of the body alone",
    "mass_ratio": "body over frame, mass",
}
"""Names of the numbers of a rig in tables."""
NOT_SHOWN = "-"  # cell of a number that a record does not show
READS = (*PARAMETERS, "k_s_over_M_s")  # ratios that tables show


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
        """Return the row of records.csv, with the same columns for every record."""
        estimate = self.estimate
        numbers = {} if estimate is None else {**estimate.ratios, **estimate.values}
        row: dict[str, Any] = {
            "record": self.record,
            "start": "" if self.start is None else self.start.isoformat(),
            "status": self.status,
            "verdict": str(self.severity),
            "reason": self.reason,
            "faults": self.faults,
        }
        for name in (*RATIOS, *ABSOLUTE):
            for end, column in (("value", name), ("low", f"{name}_low"), ("high", f"{name}_high")):
                row[column] = getattr(numbers.get(name), end, None)
        return row | {"misfit": None if estimate is None else estimate.misfit}


def holds_records(folder: Path) -> bool:
    """Return whether the first manifest of a folder is of a rig's record."""
    try:
        return is_of_rig(ManifestFile(find_manifests(folder)[0]).content)
    except (FileNotFoundError, TripError):
        return False


def _manifest(path: Path, rig: str) -> RecordManifest:
    """Return the manifest of a record; TripError if it is wrong or not of that rig."""
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

    Records are sorted by start, or by name if one has none; `n_healthy` None is all. ValueError
    names what is wrong.
    """
    manifests = all_of(partial(_manifest, path, rig.name) for path in find_manifests(folder))
    if all(manifest.start is not None for manifest in manifests):
        manifests.sort(key=lambda manifest: (str(manifest.start), manifest.name))
    records = all_of(partial(load_record, manifest) for manifest in manifests[:n_healthy])
    try:
        commissioned = commission_rig(rig, records)
    except (NoEstimateError, ValueError) as reason:
        raise ValueError(f"{folder}: {reason}") from reason
    save_rig(output, commissioned)
    write_json(output / "commissioning.json", summary_of(commissioned))
    return commissioned


def summary_of(rig: CommissionedRig) -> dict[str, Any]:
    """Return what healthy records show of a rig, as JSON-able values."""
    mass_kg = rig.rig.bogie_mass_kg
    logs = np.mean([reading.logs for reading in rig.readings], axis=0)
    si = [] if mass_kg is None else (mass_kg * np.exp(logs)).tolist()
    names = ("low_hz", "high_hz", "segment_s", "misfit", "error", "records")
    return {
        "rig": rig.rig.name,
        **{name: getattr(rig, name) for name in names},
        "level": INTERVAL_LEVEL,
        "healthy": {name: asdict(value) for name, value in rig.healthy().items()},
        "healthy_si": dict(zip(PARAMETERS, si, strict=False)),
    }


def commissioning_lines(rig: CommissionedRig) -> list[str]:
    """Return what healthy records show of a rig, as lines."""
    healthy = rig.healthy()
    rows = [[words, *_texts(healthy[name])] for name, words in SHOWN.items()]
    level = f"{100 * INTERVAL_LEVEL:g} % interval"
    return [
        f"{rig.rig.name}: {len(rig.readings)} healthy records, {rig.low_hz:.3g} to "
        f"{rig.high_hz:.3g} Hz in segments of {rig.segment_s:.3g} s",
        *tabulate(rows, ["", "healthy", level], disable_numparse=True).splitlines(),
        f"two masses on springs leave {rig.misfit:.3g} times the noise unexplained, "
        f"{100 * rig.error:.2g} % of the signals (median over frequency), which counts as noise",
        *(f"{n}: {r.doubt}" for n, r in zip(rig.records, rig.readings, strict=True) if r.doubt),
    ]


@threads(1)
def read_folder(
    rig: CommissionedRig, folder: Path, output: Path, level: float = INTERVAL_LEVEL
) -> list[RigResult]:
    """Read all records of a folder; write records.csv, .parquet and .json.

    A record that cannot be read has the reason, and harms no other. FileNotFoundError if the
    folder holds no manifest.
    """
    paths = find_manifests(folder)
    items = bar("records", len(paths), items=paths, unit="record")
    results = [_result(rig, path, level) for path in items]
    if all(result.start is not None for result in results):
        results.sort(key=lambda result: (str(result.start), result.record))
    rows = [result.row() for result in results]
    write_table(pa.Table.from_pylist(rows), output / "records")
    summary = {"rig": rig.rig.name, "level": level, "healthy": summary_of(rig), "records": rows}
    write_json(output / "records.json", summary)
    return results


def _result(rig: CommissionedRig, path: Path, level: float) -> RigResult:
    result = RigResult(path.stem, ERROR)
    try:
        manifest = _manifest(path, rig.rig.name)
        record = load_record(manifest)
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
        cells = {name: _percent(ratio) for name, ratio in result.estimate.ratios.items()}
        rows.append([result.record, *(cells[name] for name in READS), str(result.severity)])
        beyond = [
            f"{name} at {cells[name]} % of healthy"
            for name, severity in result.estimate.severities.items()
            if severity >= Severity.NOTICE
        ]
        if beyond:
            notes.append(f"{result.record}: {result.severity}: {', '.join(beyond)}")
    if hidden := {name: records for name in PARAMETERS if (records := _without(results, name))}:
        of_each = (f"{name} of {', '.join(records)}" for name, records in hidden.items())
        notes.append(f"no verdict, as the interval is too wide: {'; '.join(of_each)}")
    titles = ["record", *(name.replace("_over_", "/") for name in READS), "verdict"]
    head = f"in % of healthy, {100 * level:g} % intervals; {NOT_SHOWN}: the record does not show it"
    table = tabulate(rows, titles, disable_numparse=True) if rows else ""
    lines = [f"{rig.rig.name}: {head}", *table.splitlines(), *notes]
    return [printable(line) for line in lines]


def _without(results: Sequence[RigResult], name: str) -> list[str]:
    """Return the records that have an estimate, but are too uncertain to judge one number."""
    estimates = [(result.record, result.estimate) for result in results if result.estimate]
    return [record for record, e in estimates if e.severities.get(name) == Severity.UNKNOWN]


def _texts(value: Value, scale: float = 1.0) -> tuple[str, str]:
    """Return a number and its interval with as many digits as that is worth."""
    if value.high > WIDEST * value.low:
        return f"{scale * value.value:.3g}", NOT_SHOWN
    digits = max(3, 1 - math.floor(math.log10(max(value.high / value.low - 1, 1e-5))))
    texts = [f"{scale * end:.{digits}g}" for end in (value.value, value.low, value.high)]
    return texts[0], f"{texts[1]} to {texts[2]}"


def _percent(ratio: Value) -> str:
    value, interval = _texts(ratio, 100.0)
    return interval if interval == NOT_SHOWN else f"{value} ({interval})"
