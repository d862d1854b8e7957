"""Run folders: their names, and whether a run gets a new one or resumes an earlier one."""

import logging
import re
import sys
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from shlex import quote
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from suspnet.cli.config_files import as_written
from suspnet.cli.typed_words import quoted
from suspnet.ground import own_files
from suspnet.ground.core_yaml import read_yaml
from suspnet.ground.storage import new_folder

log = logging.getLogger(__name__)
ERROR = "error.txt"  # file with the reason in the folder of a failed job of a multirun
FLEET = "fleet.json"  # last file written by a training of several suspensions
FINISHED = ("metrics.json", FLEET)
"""Last files written by a training: of one model or several suspensions."""
NOT_COMPARED = ("resume", "progress", "threads", "workers", "language", "dataset")
"""Keys that change no number: runs that differ only in these count as the same."""
FINE, MISTAKE, SOME_WITHOUT_ESTIMATE, NOTICE, ACT = 0, 1, 2, 3, 4
"""Exit codes: success; a mistake of the user; a trip without an estimate, or a parameter that
cannot be judged; the alarm severities notice and act."""
BY_URGENCY = (FINE, SOME_WITHOUT_ESTIMATE, NOTICE, MISTAKE, ACT)
"""Exit codes, the worst last: after a mistake trips are unread, which may be worse than a
notice."""
EXIT_CODE = "exit_code"  # file with the exit code in the folder of each job of a multirun
to_resume: list[str] = []


class OwnFolder(Callback):
    """Gives each run and multirun its own folder, or the one that `resume` names.

    A folder named by ``hydra.run.dir``, ``hydra.sweep.dir`` or ``resume`` must be empty or hold
    only results: see `suspnet.ground.own_files`. A multirun with a failed job runs all others, then
    exits with code 1.
    """

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Choose the folder before Hydra makes it."""
        _choose(config, "run")
        if OmegaConf.select(config, "trips") is not None:
            to_resume[:] = [config.hydra.run.dir]

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Choose the folder before Hydra makes it, and pass it to the jobs."""
        _choose(config, "sweep")
        folder = Path(config.hydra.sweep.dir)
        to_resume[:] = [str(folder)]
        for old in folder.glob(f"*/{ERROR}"):
            old.unlink()

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Exit with 1 if a job failed; runs last, as Hydra calls callbacks in reverse order."""
        failed = sorted(Path(config.hydra.sweep.dir).glob(f"*/{ERROR}"))
        if failed:
            names = ", ".join(path.parent.name for path in failed)
            print(
                f"error: {len(failed)} jobs failed ({names}); the same command with "
                f"{quote(f'resume={config.hydra.sweep.dir}')} runs these again",
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
    codes_in_use = (code if code in BY_URGENCY else MISTAKE for code in codes)
    return max(codes_in_use, key=BY_URGENCY.index, default=FINE)


def how_to_resume() -> str:
    """Return the advice on how to resume the run that was interrupted."""
    if to_resume:
        return f"go on with the same command and {quote(f'resume={to_resume[0]}')}"
    return "start again at any time"


def _choose(config: DictConfig, kind: str) -> None:
    """Choose the folder of a run or "sweep", pass it to the sweep's jobs, and mark it as ours."""
    to_resume.clear()
    named = OmegaConf.select(config, "resume")
    before = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(config)  # interpolations in the folder's name read it
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
        goes_on = own_files.begin(folder)
    except OSError as error:
        raise SystemExit(f"error: {error.filename}: {error.strerror}") from error
    finally:
        HydraConfig.instance().cfg = before
    changed: dict[str, str | None] = {f"hydra.{kind}.dir": str(folder)}
    if goes_on:  # Hydra would write its own files again, and add to the log
        name = f"{config.hydra.job.name}_{datetime.now():%Y-%m-%d_%H-%M-%S}"
        changed |= {"hydra.output_subdir": None, "hydra.job.name": name}
    with read_write(config.hydra), open_dict(config.hydra):
        for key, value in changed.items():
            OmegaConf.update(config, key, value)
            if kind == "sweep":
                config.hydra.overrides.hydra.append(f"{key}={quoted(value) if value else 'null'}")


def _below_outputs(folder: Path) -> Path:
    """Return the default folder of a run; SystemExit if it is not below outputs."""
    if folder.parts[:1] != ("outputs",) or ".." in folder.parts:
        raise SystemExit(
            f"error: results would go to {folder}, which is not below outputs: `job` and what else "
            "its name is made of must be plain names; hydra.run.dir= on the command line names "
            "another folder"
        )
    return folder


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
        (folder / name).unlink(missing_ok=True)


def _is_finished(folder: Path) -> bool:
    return any((folder / name).is_file() for name in FINISHED)


def _saved(folder: Path) -> Any:
    """Return the compared part of config.yaml; None if it cannot be read."""
    try:
        return _compared(read_yaml(folder / "config.yaml"))
    except (OSError, TypeError, ValueError):
        return None


def _wanted(config: DictConfig) -> Any:
    """Return the compared part of a configuration."""
    return _compared(OmegaConf.to_container(config, resolve=True))


def _compared(content: Any) -> Any:
    return {key: value for key, value in dict(content).items() if key not in NOT_COMPARED}


UNNAMED = {
    *("experiment", "study", "job", "run", "out", "progress", "figures", "threads", "device"),
    *("workers", "resume", "language", "dataset"),
}
"""Keys left out of folder names: the path shows them already, or they change no number."""
MAX_BYTES = 100  # length at which a name is cut; file systems allow 255 for the whole folder name


def register() -> None:
    """Register ${changed:...} and ${unless_healthy:...} with OmegaConf."""
    OmegaConf.register_new_resolver("changed", _changed, replace=True)
    OmegaConf.register_new_resolver("unless_healthy", _unless_healthy, replace=True)


def swept() -> list[str]:
    """Return the keys that a multirun varies, in the order of its definition; [] in a single run.

    Works only within a job of the multirun.
    """
    config = HydraConfig.get()
    if config.mode != RunMode.MULTIRUN:
        return []
    folder = as_written(config.sweep)["dir"]  # a multirun sets it before its first job
    file = Path(folder) / "multirun.yaml"
    if "${" in folder or not file.is_file():
        return []
    whole = read_yaml(file)["hydra"]
    typed = OverridesParser.create().parse_overrides(whole["overrides"]["task"])
    keys = list(whole["sweeper"].get("params") or ())
    keys += [override.get_key_element() for override in typed if override.is_sweep_override()]
    return list(dict.fromkeys(keys))


def _changed(*shown: str) -> str:
    """Return the name of a run: what a multirun varies, or else what the command line sets.

    The keys `shown` are left out, as the path has them anyway. Of a multirun it is the name of
    what the command line sets for all its runs.
    """
    config, named = HydraConfig.get(), swept()
    return joined_name(
        _word(key, value, key in config.runtime.choices)
        for key, value in typed_settings().items()
        if key not in shown and (key in named or not named)
    )


def _unless_healthy(usual: float, _root_: DictConfig) -> float | None:
    """Return `usual`, or None where a folder of healthy trips shows a better value."""
    return None if OmegaConf.select(_root_, "healthy") is not None else usual


def typed_settings() -> dict[str, str]:
    """Return what the command line sets, without Hydra's marks for additions and its quotes."""
    pairs = (override.partition("=") for override in HydraConfig.get().overrides.task)
    return {key.lstrip("+~"): value.strip("'") for key, _, value in pairs}


def _word(key: str, value: str, is_choice: bool) -> str:
    """Return "svr" for model=svr, "snr_db_40" for data.snr_db=40, "" for an unnamed key."""
    if key in UNNAMED or key.startswith("hydra"):
        return ""
    last = value.rstrip("/").rpartition("/")[2]
    return last if is_choice and last else f"{key.rpartition('.')[2]}_{last}"


def joined_name(words: Iterable[str]) -> str:
    """Return words joined as the end of a folder name that needs no quotes in a shell."""
    bare = (re.sub(r"[\[\](){}'\"]", "", word) for word in words)
    plain = (re.sub(r"[^\w.+-]+", "-", word).strip("-_") for word in bare)
    return own_files.shortened("".join(f"_{word}" for word in plain if word), MAX_BYTES)
