"""Commissioned rigs as a file, rig.json, without pickle."""

import json
from dataclasses import asdict
from pathlib import Path

from suspnet._version import __version__
from suspnet.estimation.checkpoint import check_description, foreign_file
from suspnet.estimation.commissioned_rig import CommissionedRig, RigReading
from suspnet.estimation.validity import check_numbers
from suspnet.ground.storage import content_hash, read_json, write_json
from suspnet.vehicle.rig import Rig

RIG_FILE = "rig.json"
SCHEMA_VERSION = 2


def save_rig(folder: Path | str, rig: CommissionedRig) -> None:
    """Write a commissioned rig to a folder as rig.json, atomically."""
    versions = {"schema_version": SCHEMA_VERSION, "suspnet_version": __version__}
    content = json.loads(json.dumps(versions | asdict(rig), default=lambda a: a.tolist()))
    write_json(Path(folder) / RIG_FILE, content | {"description_sha256": content_hash(content)})


def load_rig(folder: Path | str) -> CommissionedRig:
    """Return the commissioned rig that `save_rig` wrote to a folder.

    Raises
    ------
    FileNotFoundError
        If there is none in the folder.
    ModelFileError
        If the file is damaged, foreign or of another schema version.
    """
    path = Path(folder) / RIG_FILE
    if not path.is_file():
        raise FileNotFoundError(f"{folder} holds no {RIG_FILE}; is it the folder of a rig's run?")
    with foreign_file(path):
        content = read_json(path)
        check_description(path, content, SCHEMA_VERSION)
        check_numbers(content, RIG_FILE)
        del content["schema_version"], content["suspnet_version"]
        if not all(isinstance(name, str) for name in content["records"]):
            raise TypeError("`records` must be names")
        return CommissionedRig(
            **content
            | {
                "rig": Rig(**content["rig"]),
                "records": tuple(content["records"]),
                "readings": tuple(RigReading(**reading) for reading in content["readings"]),
            }
        )
