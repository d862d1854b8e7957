"""Commissioned rigs as two files, rig.safetensors and rig.json, without pickle."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from suspnet._version import __version__
from suspnet.estimation.commissioned_rig import BANDS, CommissionedRig, RigReading
from suspnet.estimation.fitted import ModelFileError
from suspnet.estimation.validity import check_arrays, check_numbers
from suspnet.ground.settings import check_flag, check_number
from suspnet.ground.storage import (
    DamagedFileError,
    content_hash,
    dump_arrays,
    locked,
    read_arrays,
    read_json,
    write_atomically,
    write_json,
)
from suspnet.ground.types import FloatArray
from suspnet.vehicle.rig import Rig

DESCRIPTION, ARRAYS = "rig.json", "rig.safetensors"
SCHEMA_VERSION = 1
BAND = ("segment_s", "low_hz", "high_hz")
OF_READINGS = ("logs", "covariance", "influences", "errors")
"""Arrays of each healthy record; its scalars lie in the description."""
SCALARS = ("misfit", "bare_misfit", "converged")


def save_rig(folder: Path | str, rig: CommissionedRig) -> None:
    """Write a commissioned rig to a folder, each file atomically, with the folder locked."""
    folder = Path(folder)
    content = dump_arrays(
        {name: np.stack([getattr(r, name) for r in rig.readings]) for name in OF_READINGS}
    )
    description = {
        "schema_version": SCHEMA_VERSION,
        "suspnet_version": __version__,
        "rig": asdict(rig.rig),
        "records": list(rig.records),
        "readings": [{name: getattr(r, name) for name in SCALARS} for r in rig.readings],
        "arrays_sha256": hashlib.sha256(content).hexdigest(),
        **{name: getattr(rig, name) for name in BAND},
    }
    description["description_sha256"] = content_hash(description)
    with locked(folder):
        write_atomically(folder / ARRAYS, content)
        write_json(folder / DESCRIPTION, description)


def load_rig(folder: Path | str) -> CommissionedRig:
    """Return the commissioned rig that `save_rig` wrote to a folder.

    Raises
    ------
    FileNotFoundError
        If there is none in the folder.
    ModelFileError
        If a file is damaged, foreign or of another schema version.
    """
    path = Path(folder) / DESCRIPTION
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} holds no {DESCRIPTION}; is it the folder of a rig's run?"
        )
    try:
        content = read_json(path)
        _check_description(path, content)
        arrays = read_arrays(path.with_name(ARRAYS), content["arrays_sha256"])
        return _checked(content, arrays)
    except ModelFileError:
        raise
    except DamagedFileError as error:
        raise ModelFileError(f"{error}; train again or copy the run again") from error
    except FileNotFoundError as error:
        raise ModelFileError(f"{folder} holds {DESCRIPTION} but no {ARRAYS}") from error
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise ModelFileError(f"{path} is not a commissioned rig: {error!r}") from error


def _check_description(path: Path, content: Any) -> None:
    if not isinstance(content, dict) or content.get("schema_version") != SCHEMA_VERSION:
        raise ModelFileError(
            f"{path} is not a commissioned rig of schema version {SCHEMA_VERSION}: train again"
        )
    if content.pop("description_sha256", None) != content_hash(content):
        raise ModelFileError(f"{path} is damaged or was altered: its hash does not match")


def _checked(content: dict[str, Any], arrays: dict[str, FloatArray]) -> CommissionedRig:
    """Return the rig of a description and arrays whose shapes and values are possible."""
    check_numbers(content, DESCRIPTION)
    check_arrays(arrays)
    if not all(isinstance(name, str) for name in content["records"]):
        raise TypeError("`records` must be names")
    n = len(content["records"])
    shapes = {"logs": (n, 5), "covariance": (n, 5, 5), "influences": (n, BANDS, 5)}
    for name, shape in shapes.items():
        if arrays[name].shape != shape:
            raise ValueError(f"`{name}` must be of shape {shape}, got {arrays[name].shape}")
    errors = arrays["errors"]
    if errors.shape[::2] != (n, 3) or not (errors >= 0).all():
        raise ValueError("`errors` must be numbers >= 0, a row of three for each bin of a record")
    if set(arrays) != set(OF_READINGS):
        raise ValueError(f"unknown arrays: {sorted(set(arrays) - set(OF_READINGS))}")
    for covariance in arrays["covariance"]:
        if not np.allclose(covariance, covariance.T) or np.linalg.eigvalsh(covariance)[0] <= 0:
            raise ValueError("`covariance` must be symmetric and positive definite")
    for scalars in content["readings"]:
        check_flag("converged", scalars["converged"])
        for name in SCALARS[:2]:
            check_number(name, scalars[name], low=0)
    rows = zip(*(arrays[name] for name in OF_READINGS), content["readings"], strict=True)
    readings = tuple(
        RigReading(*row, **{name: scalars[name] for name in SCALARS}) for *row, scalars in rows
    )
    band = {name: content[name] for name in BAND}
    return CommissionedRig(
        Rig(**content["rig"]), records=tuple(content["records"]), readings=readings, **band
    )
