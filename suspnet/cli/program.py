"""Shared parts of the programs: one-line errors, checked configurations, signals, output."""

import functools
import gc
import logging
import os
import re
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext
from difflib import get_close_matches
from importlib import import_module
from pathlib import Path
from string import Template
from types import ModuleType
from typing import Any
from urllib.parse import unquote

import hydra
import yaml
from hydra._internal import hydra as hydra_application
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException, InstantiationException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from suspnet.cli import config_files, folders, signals
from suspnet.cli.config_files import CONFIGS, as_written, check_values
from suspnet.cli.loader import CheckedLoader
from suspnet.cli.typed_words import as_overrides
from suspnet.ground import progress, workers
from suspnet.ground.extras import missing_words, named_extras
from suspnet.ground.parameters import DEFAULT_LIMITS, read_limits
from suspnet.ground.settings import check_number
from suspnet.ground.storage import printable, why, write_atomically

WITH_OPTIONS = ("check", "demo", "history", "init")  # programs that read no configuration
POOLS = {
    "evaluate": ("suspnet.trains.jobs.fleet", "monitor.workers", "trips"),
    "simulate": ("suspnet.trains.simulation.writing", "workers", "out"),
}
"""Programs with worker processes: the module that these need, the key of their number, and the key
that is not null where they have work."""
DEBUG = "HYDRA_FULL_ERROR"
MISTAKES = (
    *(ValueError, TypeError, OSError, MemoryError, RecursionError),
    *(yaml.YAMLError, HydraException, OmegaConfBaseException),
)
SERVER = re.compile(r"\bpostgres(ql)?(\+\w+)?://")
PASSWORD = re.compile(r"(?<=://)([^:/@]*):([^@]*)@|(?<=[?&])password=([^&'\"]*)&?")
"""Password in the URL of a server, after the user or as an option."""
OF_ANOTHER_PROGRAM = {
    "experiment": "is of train.py, studies are of evaluate.py: python train.py experiment=NAME",
    "study": "is of evaluate.py, experiments are of train.py: python evaluate.py study=NAME",
}
"""Groups that Hydra does not find because they belong to another program, and a hint."""
is_debugging = bool(os.environ.get(DEBUG, "") not in ("", "0"))

config_files.register()
folders.register()


def main(name: str) -> None:
    """Run a program as the command line says.

    Its modules take seconds to import, so they are imported only once there is something to do.
    """
    # a library of optional readers greets at its import, on the output that Hydra has set up
    logging.getLogger("numexpr").setLevel(logging.WARNING)
    sys.argv[1:] = map(_without_password, sys.argv[1:])
    if name in WITH_OPTIONS:
        run(lambda: _run_with_options(name))
        return
    sys.argv[1:] = as_overrides(sys.argv[1:])
    program = hydra.main(version_base="1.3", config_path=CONFIGS, config_name=name)(_task_of(name))
    with signals.until_it_listens() if name == "serve" else nullcontext():
        run(program, unwinds=name != "serve")


def _run_with_options(name: str) -> None:
    parser = import_module("suspnet.cli.options").PARSERS[name]()
    # files and KEY=VALUE may come between options, which argparse allows without subcommands
    is_mixed = name != "history"
    arguments = parser.parse_intermixed_args() if is_mixed else parser.parse_args()
    sys.exit(getattr(_imported(name), name)(arguments))


def _without_password(argument: str) -> str:
    """Return an argument without the password of a PostgreSQL URL, which goes to the environment.

    Hydra writes all arguments to files that others may read; libpq looks in the environment.
    """

    def take(part: re.Match[str]) -> str:
        os.environ["PGPASSWORD"] = unquote(part[2] if part[2] is not None else part[3])
        return f"{part[1]}@" if part[2] is not None else ""

    return PASSWORD.sub(take, argument) if SERVER.search(argument) else argument


def _task_of(name: str) -> Callable[[DictConfig], None]:
    def program(config: DictConfig) -> None:
        _serve_workers(name, config)
        try:  # Hydra would print a line of its own about an error that leaves this function
            with named_extras("live" if name == "serve" else None):
                main = _imported(name).main
        except ValueError as error:
            raise SystemExit(one_line(error)) from None
        main(config)

    program.__module__ = f"suspnet.cli.{name}"  # Hydra names the log by it
    return program


def _serve_workers(name: str, config: DictConfig) -> None:
    """Let another process import what workers need, while this one imports the program."""
    module, number, work = POOLS.get(name, ("", "", ""))
    n_workers = OmegaConf.select(config, number) if OmegaConf.select(config, work) else None
    if isinstance(n_workers, int):  # null depends on the number of trips
        workers.fork_from_server(module, n_workers)


def _imported(name: str) -> ModuleType:
    """Return the module of a program; a signal while it is imported ends the process at once.

    What is imported stays to the end: from here garbage is collected, but not looked for in it.
    """
    with signals.until_it_listens():
        module = import_module(f"suspnet.cli.{name}")
    if not gc.isenabled():  # once, not in each job of a multirun, whose garbage would stay
        gc.freeze()
        gc.enable()
    return module


def run(main: Callable[[], Any], *, unwinds: bool = True) -> None:
    """Run a Hydra program; end with one line and exit code 1 on a mistake, 130 on Ctrl-C.

    The exit code of SIGTERM is 143, unless the program handles signals itself (`unwinds` is false).
    HYDRA_FULL_ERROR=1 shows the traceback instead.
    """
    workers.guard_joblib()
    if "TORCHELASTIC_RUN_ID" in os.environ:  # every process would write the same run
        sys.exit("error: torchrun cannot spread a program over processes: start it with python")
    try:
        with (
            progress.visible(),
            signals.terminable() if unwinds else nullcontext(),
            workers.environment({DEBUG: "1"}),  # Hydra raises errors, here and in child processes
            _checked_loader(),
            named_extras(),
        ):
            main()
    except SystemExit as ended:  # its message may hold names of files
        if isinstance(ended.code, str):
            ended.code = printable(ended.code)
        raise
    except (KeyboardInterrupt, signals.Terminated) as ended:
        number = signal.SIGTERM if isinstance(ended, signals.Terminated) else signal.SIGINT
        verb, code = signals.VERBS[number], 128 + number
        how = printable(folders.how_to_resume())
        print(f"{verb}: nothing was half-written; {how}", file=sys.stderr)
        sys.exit(code)
    except BrokenPipeError:
        sys.exit(signals.output_ended())
    except MISTAKES as error:
        if is_debugging:
            raise
        sys.exit(one_line(error))
    except (workers.LostWorkerError, BrokenProcessPool) as error:
        sys.exit(f"{one_line(error)}; {folders.how_to_resume()}")


@contextmanager
def _checked_loader() -> Iterator[None]:
    """Make Hydra compose trusted configurations only; refuse its option that reads a pickle."""
    if get_args_parser().parse_known_args()[0].experimental_rerun is not None:
        raise ValueError("--experimental-rerun reads a pickle, which can run any code: not allowed")
    application: Any = hydra_application
    hydra_class, loader = application.Hydra, application.ConfigLoaderImpl
    get_help, get_mode = hydra_class.get_help, hydra_class.get_mode

    def mode(self: Any, config_name: str, overrides: list[str]) -> RunMode | None:
        # Hydra composes everything once more to find the mode, which no setting of serve changes
        if config_name == "serve" and not any(
            word[:1] in ("-", "+") or word[:5] == "hydra" for word in sys.argv[1:]
        ):
            return RunMode.RUN
        found: RunMode | None = get_mode(self, config_name, overrides)
        return found

    application.ConfigLoaderImpl = CheckedLoader
    hydra_class.get_help, hydra_class.get_mode = _help, mode
    try:
        yield
    finally:
        application.ConfigLoaderImpl = loader
        hydra_class.get_help, hydra_class.get_mode = get_help, get_mode


def _help(self: Any, help_cfg: DictConfig, *_: Any, **__: Any) -> str:
    """Return the help of a configuration; Hydra's own method first lists all groups, slowly."""
    return Template(help_cfg.template).safe_substitute()


def task(function: Callable[[DictConfig], Any]) -> Callable[[DictConfig], Any]:
    """Wrap a Hydra task function: check its configuration, end with one line on a mistake.

    In a job of a multirun every error is one line, the traceback of a bug goes to error.txt, and
    the other jobs run; the job returns the exit code of a mistake.
    """

    @functools.wraps(function)
    def wrapped(config: DictConfig) -> Any:
        workers.end_with_parent()
        try:
            check_values(config)
            _check_limits(config)
            with _progress(), named_extras():
                return function(config)
        except BrokenPipeError:
            raise SystemExit(signals.output_ended()) from None
        except Exception as error:
            if is_debugging or not (isinstance(error, MISTAKES) or folders.is_job()):
                raise
            if isinstance(error, MISTAKES):
                line = one_line(error)
            else:
                line = f"error: {note_bug(error, run_folder())}"
            if not folders.is_job():
                raise SystemExit(line) from None
            return _end_job(line)

    return wrapped


def _end_job(line: str) -> int:
    """Print why a job of a multirun failed, write error.txt, and return its exit code."""
    print(line, file=sys.stderr)
    file = run_folder() / folders.ERROR
    if not file.exists():
        write_atomically(file, f"{line}\n")
    return folders.MISTAKE


def _progress() -> AbstractContextManager[None]:
    """Send progress lines to standard error, with the job's number in a multirun."""
    if not logging.getLogger().handlers:  # hydra/job_logging=none asks for silence
        return nullcontext()
    job = HydraConfig.get().job
    return progress.on_stderr("" if OmegaConf.is_missing(job, "num") else f"{job.num}: ")


def _check_limits(config: DictConfig) -> None:
    """Check the vehicle's limits; an error names the vehicle's file."""
    try:
        read_limits(OmegaConf.select(config, "vehicle.limits") or {}, DEFAULT_LIMITS)
    except (TypeError, ValueError) as error:
        chosen = HydraConfig.get().runtime.choices.get("vehicle")
        raise type(error)(f"vehicle/{chosen}.yaml: {error}") from None


def note_bug(error: Exception, folder: Path) -> str:
    """Write the traceback of the error that is handled to error.txt; return a line that says so."""
    file = write_atomically(folder / folders.ERROR, traceback.format_exc())
    return f"{type(error).__name__}: {' '.join(str(error).split())}; see {file}"


def one_line(error: BaseException) -> str:
    """Return an error's message on one line, without Hydra's wrapping and search paths."""
    # ends: a cause is older than its error
    while isinstance(error.__cause__, MISTAKES) and (
        isinstance(error, InstantiationException) or not str(error)
    ):
        error = error.__cause__
    message = text = str(error)
    if not isinstance(error, ValueError):
        message = missing_words(error) or message
    if isinstance(error, RecursionError):
        message = "the configuration is nested too deeply, or refers to itself"
    if isinstance(error, MemoryError):
        message = f"not enough memory: {message or 'ask for less at a time'}"
    for noise in ("Config search path", "full_key:", "To append to your "):
        message = message.split(noise)[0]
    if message.startswith("Could not override"):
        start = message.strip().rstrip(".")
        message = f"{start}. There is no such key{_nearest_key(error)}; --help lists them"
    for name, hint in OF_ANOTHER_PROGRAM.items():
        if f"override '{name}'" in text and "Could not" in text:
            message = f"{name} {hint}"
    if isinstance(error, OSError) and error.filename is not None:
        message = why(error)
    return printable("error: " + " ".join(message.split()))


def _nearest_key(error: BaseException) -> str:
    """Return the key nearest to one that cannot be overridden, as a question; empty for none."""
    cause: Any = error.__cause__
    place = getattr(cause, "parent_node", None)
    if not isinstance(place, DictConfig):
        return ""
    if not place:  # a mapping to be filled
        return ": a + before it adds it"
    near = get_close_matches(str(cause.key), [str(key) for key in place], n=1)
    return f": did you mean {near[0]}?" if near else ""


def run_folder() -> Path:
    """Return the folder that Hydra made for this run."""
    return Path(HydraConfig.get().runtime.output_dir)


def n_threads(wanted: int | None) -> int:
    """Set the threads of torch and BLAS to `wanted`, or leave them if None; return their number."""
    import torch  # takes seconds
    from threadpoolctl import threadpool_limits

    if wanted is None:
        return torch.get_num_threads()
    check_number("threads", wanted, low=1, most=1024, whole=True)
    threadpool_limits(wanted)
    torch.set_num_threads(wanted)
    return wanted


def save_config(config: DictConfig, folder: Path) -> dict[str, Any]:
    """Write the resolved configuration to config.yaml and return it as plain values."""
    write_atomically(folder / "config.yaml", OmegaConf.to_yaml(config, resolve=True))
    return as_written(config, resolve=True)
