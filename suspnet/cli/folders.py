"""Run folders: a new one for each run, or that of an earlier run that is resumed."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml
from hydra.core.hydra_config import HydraConfig
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from suspnet.cli.kinds import KINDS
from suspnet.ground import ledger
from suspnet.ground.storage import new_folder, write_atomically

log = logging.getLogger(__name__)
ERROR = "error.txt"
"""File with the reason in the folder of a failed job of a multirun."""
FLEET = "fleet.json"
"""Last file written by a training of several suspensions."""
FINISHED = ("metrics.json", "speeds.json", FLEET)
"""Last files written by a training: of one model, several speeds or several suspensions."""
NOT_COMPARED = ("resume", "progress", "threads", "workers", "data.cache_dir")
"""Keys that change no number: runs that differ only in these count as the same."""
FINE, MISTAKE, SOME_WITHOUT_ESTIMATE, NOTICE, ACT = 0, 1, 2, 3, 4
"""Exit codes: success; a mistake of the user; a trip without an estimate, or a parameter that
cannot be judged; the alarm severities notice and act."""
BY_URGENCY = (FINE, SOME_WITHOUT_ESTIMATE, NOTICE, MISTAKE, ACT)
"""Exit codes, the worst last: after a mistake trips are unread, which may be worse than a
notice."""
EXIT_CODE = "exit_code"
"""File with the exit code in the folder of each job of a multirun."""
_to_go_on: list[str] = []


class OwnFolder(Callback):
    """Gives each run and multirun its own folder, or the one that `resume` names.

    A folder named by ``hydra.run.dir``, ``hydra.sweep.dir`` or ``resume`` must be empty or hold
    only results: see `suspnet.ground.ledger`. A multirun with a failed job runs all others, then
    exits with code 1.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Choose the folder before Hydra makes it."""
        before = HydraConfig.instance().cfg
        HydraConfig.instance().set_config(config)  # interpolations in the folder's name read it
        try:
            _choose(config, "run")
        finally:
            HydraConfig.instance().cfg = before
        if OmegaConf.select(config, "trips") is not None:
            _to_go_on[:] = [config.hydra.run.dir]

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Choose the folder before Hydra makes it, and pass it to the jobs."""
        if int(os.environ.get("WORLD_SIZE", "1")) > 1:
            raise SystemExit(
                "error: a multirun cannot be spread by torchrun: start it with python, and "
                "hydra/launcher=joblib or hydra/launcher=slurm for several jobs at a time"
            )
        _choose(config, "sweep")
        folder = Path(config.hydra.sweep.dir)
        _to_go_on[:] = [str(folder)]
        for old in folder.glob(f"*/{ERROR}"):
            ledger.remove(old)
        # record the file in the ledger: Hydra writes the same bytes again
        write_atomically(folder / ledger.MULTIRUN, OmegaConf.to_yaml(config))

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Exit with 1 if a job failed; runs last, as Hydra calls callbacks in reverse order."""
        failed = sorted(Path(config.hydra.sweep.dir).glob(f"*/{ERROR}"))
        if failed:
            names = ", ".join(path.parent.name for path in failed)
            print(
                f"error: {len(failed)} jobs failed ({names}); the same command with "
                f"resume={config.hydra.sweep.dir} runs these again",
                file=sys.stderr,
            )
            sys.exit(1)


class WorstExitCode(Callback):
    """Ends a multirun with the worst exit code of its jobs."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Read the exit codes in the folders of the jobs, and exit with the worst."""
        files = sorted(Path(config.hydra.sweep.dir).glob(f"*/{EXIT_CODE}"))
        code = worst(int(file.read_text()) for file in files)
        if code:
            sys.exit(code)


def worst(codes: Iterable[int]) -> int:
    """Return the most urgent exit code; an unknown one counts as a mistake."""
    known = (code if code in BY_URGENCY else MISTAKE for code in codes)
    return max(known, key=BY_URGENCY.index, default=FINE)


def how_to_go_on() -> str:
    """Return the advice on how to resume the run that was interrupted."""
    if _to_go_on:
        return f"go on with the same command and resume={_to_go_on[0]}"
    return "start again at any time"


def _choose(config: DictConfig, kind: str) -> None:
    """Choose the folder of a run or "sweep", pass it to the sweep's jobs, and start its ledger."""
    _to_go_on.clear()
    named = OmegaConf.select(config, "resume")
    try:
        if named is not None:
            folder = Path(str(named))
            if not folder.is_dir():  # Hydra turns other exceptions into warnings
                raise SystemExit(
                    f"error: resume={folder} is no folder; give that of the earlier run"
                )
        elif any(str(o).startswith(f"hydra.{kind}.dir=") for o in config.hydra.overrides.hydra):
            folder = Path(config.hydra[kind].dir)
        else:
            folder = new_folder(_below_outputs(Path(config.hydra[kind].dir)))
        goes_on = ledger.begin(folder)
    except OSError as error:
        raise SystemExit(f"error: {error.filename}: {error.strerror}") from error
    changed: dict[str, str | None] = {f"hydra.{kind}.dir": str(folder)}
    if goes_on:  # Hydra would write its own files again, and add to the log
        name = f"{config.hydra.job.name}_{datetime.now():%Y-%m-%d_%H-%M-%S}"
        changed |= {"hydra.output_subdir": None, "hydra.job.name": name}
    with read_write(config.hydra), open_dict(config.hydra):
        for key, value in changed.items():
            OmegaConf.update(config, key, value)
            if kind == "sweep":
                config.hydra.overrides.hydra.append(f"{key}={_quoted(value)}")


def _below_outputs(folder: Path) -> Path:
    """Return the default folder of a run; SystemExit if it is not below outputs."""
    if folder.parts[:1] != ("outputs",) or ".." in folder.parts:
        raise SystemExit(
            f"error: results would go to {folder}, which is not below outputs: `job` and what else "
            "its name is made of must be plain names; hydra.run.dir= on the command line names "
            "another folder"
        )
    return folder


def _quoted(value: str | None) -> str:
    if value is None:
        return "null"
    escaped = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def is_job() -> bool:
    """Return whether this run is a job of a multirun."""
    return bool(HydraConfig.get().mode == RunMode.MULTIRUN)


def finished_run(config: DictConfig, folder: Path) -> Path | None:
    """Return the folder of a finished training of the same configuration, if this run resumes.

    In a multirun it may be that of another job, as added jobs change the numbering; the folder of
    this job then holds only a log that says so. ValueError if the folder holds a finished training
    of another configuration.
    """
    if is_finished(config, folder):
        return folder if is_job() or OmegaConf.select(config, "resume") is not None else None
    if not is_job():
        return None
    wanted = _wanted(config)
    for other in sorted(path.parent for path in folder.parent.glob("*/config.yaml")):
        if other != folder and _is_finished(other) and _saved(other) == wanted:
            return other
    return None


def is_finished(config: DictConfig, folder: Path) -> bool:
    """Return whether a folder holds a finished training; ValueError if of another configuration."""
    if not _is_finished(folder):
        return False
    if _saved(folder) != _wanted(config):
        raise ValueError(f"{folder} holds a finished run of other settings; give another folder")
    return True


def start_again(folder: Path) -> None:
    """Remove the files of an earlier run that mark it as failed or finished."""
    for name in (ERROR, *FINISHED):
        ledger.remove(folder / name)


def _is_finished(folder: Path) -> bool:
    return any((folder / name).is_file() for name in FINISHED)


def _saved(folder: Path) -> Any:
    """Return the compared part of config.yaml; None if it cannot be read."""
    try:
        return _compared(yaml.safe_load((folder / "config.yaml").read_text(encoding="utf-8")))
    except (OSError, ValueError, yaml.YAMLError):
        return None


def _wanted(config: DictConfig) -> Any:
    """Return the compared part of a configuration."""
    return _compared(OmegaConf.to_container(config, resolve=True))


def _compared(content: Any) -> Any:
    config = OmegaConf.create(_with_kinds(content, ""))
    for key in NOT_COMPARED:
        section, _, last = key.rpartition(".")
        node = OmegaConf.select(config, section) if section else config
        if isinstance(node, DictConfig):
            node.pop(last, None)
    return OmegaConf.to_container(config)


def _with_kinds(content: Any, place: str) -> Any:
    """Return a configuration of an earlier version in its present form: kinds, not targets."""
    if not isinstance(content, dict):
        return content
    found = {key: _with_kinds(one, str(key)) for key, one in content.items() if key[:1] != "_"}
    kinds = KINDS.get(place, {})
    kind = next((kind for kind, home in kinds.items() if home == content.get("_target_")), "")
    return {"kind": kind, **found} if kind else found
