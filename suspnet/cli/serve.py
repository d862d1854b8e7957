"""Show a fleet's history in the browser: suspnet-serve store=FILE [KEY=VALUE ...]."""

from __future__ import annotations

import gc
import logging
import os
import re
import signal
import socket
import sys
import threading
import webbrowser
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, ListConfig, OmegaConf

from suspnet.cli import program, signals
from suspnet.cli.kinds import board_settings
from suspnet.depot.live.broker import secret
from suspnet.ground.extras import check_extra
from suspnet.ground.settings import Checked, setting
from suspnet.runs.language import check_language
from suspnet.trains.history import History
from suspnet.trains.history.database import BusyError
from suspnet.trains.pages.board import LOOK_S, Board

if TYPE_CHECKING:
    from suspnet.depot.web.access import Access

log = logging.getLogger(__name__)
END_S = 2.0  # longest wait for each part of the program at the end, [s]
TOKEN_VARIABLE = "SUSPNET_API_TOKEN"
"""Environment variable with the token of programs; with _FILE after its name, of its file."""
ANY = "0.0.0.0"  # address that means all addresses of this computer


@dataclass(frozen=True)
class ServeSettings(Checked):
    """Numbers of the server."""

    port: int = setting(8050, "Port that is listened on; 0 is any that is free", low=0, high=65535)
    refresh_s: float = setting(
        3.0,
        "Time between looks at the store for what is new, and between a page's questions",
        "s",
        low=0.2,
        high=3600,
    )
    threads: int = setting(8, "Number of answers that are made at the same time", low=1, most=64)


@program.task
def main(config: DictConfig) -> None:
    """Check the settings and serve the pages until Ctrl-C."""
    check_extra("live")
    if OmegaConf.is_missing(config, "store") or not config.store:
        raise ValueError("which history? Give store=FILE, or store=postgresql://...")
    ServeSettings(config.port, config.refresh_s, config.threads)
    if config.language is not None:
        check_language(config.language)
    # a large store takes as long to check as the imports of the others
    with ThreadPoolExecutor(1) as pool:
        checked = pool.submit(_check_store, config.store)
        _check_address(config)
        _prefix(config.url_prefix)
        _access(config)
        checked.result()
    serve(Board(config.store, board_settings(config, config)), config)


def serve(board: Board, config: DictConfig) -> None:
    """Serve the pages of a fleet until a signal ends it, with SystemExit of 128 plus its number.

    ValueError if the address is taken or not of this computer, or the server ends by itself.
    """
    from suspnet.depot.web.app import create_app, http_server
    from suspnet.trains.pages.board import Refresher

    refresher = Refresher(board, config.refresh_s)
    host_names = [*config.hosts, *([] if config.host == ANY else [config.host])]
    app = create_app(refresher, host_names, config.refresh_s, _access(config), config.language)
    try:
        listening = socket.create_server((config.host, config.port))
    except OSError as error:
        words = error.strerror or str(error)
        raise ValueError(f"{config.host}:{config.port}: {words}; choose another port=") from None
    prefix = _prefix(config.url_prefix)
    server = http_server(app, listening, config.threads, prefix)
    address = f"http://{config.host}:{listening.getsockname()[1]}{prefix}/"
    gc.collect()
    gc.freeze()  # collections that scan imported objects would delay answers
    # The main thread only waits for a signal: the server would catch and log an exception that a
    # signal raises during a request, and continue.
    ended: SimpleQueue[int] = SimpleQueue()
    for number in signals.SIGNALS:
        signal.signal(number, lambda number, _: ended.put(number))
    log.info("the fleet is at %s (Ctrl-C ends it)", address)
    refresher.start()
    threading.Thread(target=_run, args=(server, ended), name="server", daemon=True).start()
    if config.open_browser:
        threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()
    code = ended.get()  # 0 from the server's thread: it has ended by itself
    signals.end_at_once()  # from now on a signal ends the program without waiting
    refresher.stop(END_S)
    server.task_dispatcher.shutdown(timeout=END_S)
    if not code:
        raise ValueError("the server has ended by itself; start suspnet-serve again")
    print(f"{signals.VERBS[signal.Signals(code)]}: the pages are no longer served", file=sys.stderr)
    sys.exit(128 + code)


def _run(server: Any, ended: SimpleQueue[int]) -> None:
    """Answer requests, and wake the main thread if that ends."""
    try:
        server.run()
    finally:
        ended.put(0)


def _check_store(store: str) -> None:
    """Raise ValueError if a store cannot be used; one that is missing or locked may still come."""
    if "://" in store or os.path.lexists(store):
        is_empty = os.path.isfile(store) and os.path.getsize(store) == 0
        try:
            if not is_empty:
                with History(store, wait_s=LOOK_S, must_exist=True) as history:
                    history.check()
                return
        except BusyError as error:
            log.warning("%s; the pages wait for it", error)
            return
    folder = Path(store).absolute().parent
    if not folder.is_dir():
        raise ValueError(f"{store}: there is no folder {folder}")
    log.warning("%s: no trip is stored there yet; the pages wait for the first", store)


def _access(config: DictConfig) -> Access:
    """Return who may see and acknowledge; ValueError if the settings or the token are not valid."""
    from suspnet.depot.web.access import Access

    for name in ("trusted_proxies", "engineers"):
        if not isinstance(config[name], ListConfig):
            raise ValueError(f"`{name}` is a list, as {name}=[NAME, ...], got {config[name]!r}")
    is_given = any(os.environ.get(TOKEN_VARIABLE + end) for end in ("", "_FILE"))
    return Access(
        str(config.user_header or ""),
        [str(address) for address in config.trusted_proxies],
        [str(name) for name in config.engineers],
        secret(TOKEN_VARIABLE, "the API") if is_given else "",
    )


def _prefix(path: str | None) -> str:
    """Return the path of the pages without a / at its end; ValueError if it is not a path."""
    prefix = str(path or "").rstrip("/")
    if not re.fullmatch(r"(/[A-Za-z0-9_~-][A-Za-z0-9._~-]*)*", prefix, re.ASCII):
        raise ValueError(
            f"`url_prefix` must be the path at which a reverse proxy shows the pages, as /fleet/, "
            f"got {path!r}"
        )
    return prefix


def _check_address(config: DictConfig) -> None:
    """Raise ValueError if other computers could reach the pages without being asked for."""
    from suspnet.depot.web.app import is_loopback

    if ":" in config.host or not config.host:
        raise ValueError(f"`host` must be an IPv4 address or a name, got {config.host!r}")
    if is_loopback(config.host):
        return
    if not config.open_to_network:
        no_login = "" if config.user_header else ", and there is no login"
        raise ValueError(
            f"host={config.host} can be reached by other computers{no_login}; give "
            "open_to_network=true if that is meant"
        )
    if config.host == ANY and not config.hosts:
        raise ValueError(f"by which names may host={ANY} be asked for? Give hosts=[NAME, ...]")
    if config.user_header:
        return
    log.warning(
        "warning: whoever reaches %s:%d sees the fleet and can acknowledge alarms: there is no "
        "login; put a reverse proxy with one in front",
        config.host,
        config.port,
    )
