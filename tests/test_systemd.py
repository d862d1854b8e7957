"""The units of examples/systemd are valid, hardened, and start the programs as they are."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from suspnet.cli.config_files import CONFIGS
from suspnet.cli.options import history_parser

UNITS = sorted((Path(__file__).parents[1] / "examples" / "systemd").glob("suspnet-*"))
SERVICES = [unit for unit in UNITS if unit.suffix == ".service"]
MOST_EXPOSED = 25
"""Largest exposure by `systemd-analyze security`, from 0 to 100."""


@pytest.fixture(scope="module")
def units(tmp_path_factory):
    """The units in a folder, with programs that exist."""
    folder = tmp_path_factory.mktemp("units")
    for unit in UNITS:
        text = unit.read_text(encoding="utf-8")
        (folder / unit.name).write_text(re.sub(r"/opt/suspnet/bin/suspnet-\w+", "/bin/true", text))
    return folder


def analyze(*arguments):
    program = shutil.which("systemd-analyze")
    if program is None:
        pytest.skip("needs systemd-analyze")
    found = subprocess.run([program, *map(str, arguments)], capture_output=True, text=True)
    if "Unknown command verb" in found.stderr or "unrecognized option" in found.stderr:
        pytest.skip("needs systemd-analyze of systemd 250 or later")
    return found


def test_units_are_valid(units):
    found = analyze("verify", "--man=no", *(units / unit.name for unit in UNITS))
    ours = [line for line in found.stderr.splitlines() if "suspnet" in line]
    assert (found.returncode, ours) == (0, []), found.stderr


@pytest.mark.parametrize("unit", SERVICES, ids=lambda unit: unit.stem)
def test_services_are_hardened(units, unit):
    found = analyze("security", "--offline=yes", f"--threshold={MOST_EXPOSED}", units / unit.name)
    assert found.returncode == 0, found.stdout[-300:]
    assert "Overall exposure level" in found.stdout


@pytest.mark.parametrize("unit", SERVICES, ids=lambda unit: unit.stem)
def test_commands_are_those_of_the_programs(unit):
    text = unit.read_text(encoding="utf-8").replace("\\\n", " ").replace("$$(date +%%u)", "1")
    (line,) = re.findall(r"^ExecStart=(.*)$", text, re.M)
    words = shlex.split(line)
    if words[0] == "/bin/sh":
        words = shlex.split(words[2].removeprefix("exec "))
    if words[0] == "/usr/bin/sqlite3":
        folder = "/var/lib/suspnet"
        assert words[1:] == [f"{folder}/fleet.db", f".backup {folder}/backups/fleet-1.db"]
        return
    name = words[0].removeprefix("/opt/suspnet/bin/suspnet-")
    if name == "history":
        assert history_parser().parse_args(words[1:]).does == "notify"
        return
    with initialize_config_dir(version_base="1.3", config_dir=CONFIGS):
        config = compose(name, [*words[1:]], return_hydra_config=True)
    assert config.store == "/var/lib/suspnet/fleet.db"
    assert set(config.hydra.job_logging.handlers) == {"console"}  # no file that grows
