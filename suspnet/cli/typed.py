"""What a configuration may not decide: with which machines a program speaks, and who hears it.

A configuration may come from someone else. The hosts that samples, estimates and credentials go to
are therefore named by the user: on the command line, or in an environment variable.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from suspnet.cli.configs import CONFIGS
from suspnet.live.broker import HOST_VARIABLE, LOCAL

BROKERS = ("source", "sink")
"""Groups whose options speak with a broker, which they describe below `broker`."""


def check_typed(config: DictConfig, typed: Collection[str]) -> None:
    """Raise unless the user has named each machine that a configuration would speak with.

    Parameters
    ----------
    config : DictConfig
        As composed, with Hydra's own block.
    typed : collection of str
        Keys of the command line, without those of a file and of what a multirun sweeps over.

    Raises
    ------
    ValueError
        If the settings of a broker are not as shipped, and its host is named by neither the command
        line nor the environment; if a store is the URL of a server, or pages are opened to the
        network, and the command line does not say so.
    """
    written = OmegaConf.to_container(config, resolve=False)
    assert isinstance(written, dict)
    for group in BROKERS:
        if group in written:
            _check_broker(group, written[group], typed)
    store = written.get("store")
    if "store" not in typed and not _is_local(store):
        raise ValueError(
            f"`store` is {store!r}: a server is named on the command line only, store=URL"
        )
    if written.get("open_to_network", False) is not False and "open_to_network" not in typed:
        raise ValueError(
            "pages are opened to the network on the command line only: open_to_network=true"
        )
    swept = OmegaConf.to_container(config.hydra.sweeper.get("params") or DictConfig({}))
    for key in swept if isinstance(swept, dict) else ():
        if str(key).lstrip("+~").split(".")[0] in (*BROKERS, "store", "open_to_network"):
            raise ValueError(f"`hydra.sweeper.params.{key!s}` is swept on the command line only")


def _check_broker(group: str, option: Any, typed: Collection[str]) -> None:
    """Raise ValueError if a broker is not as shipped, and the user has not named its host."""
    broker = option.get("broker", {}) if isinstance(option, dict) else option
    if not isinstance(broker, dict):  # an interpolation would hide what it will be
        raise ValueError(f"`{group}` must be an option of the group {group}, got {broker!r}")
    shipped = _shipped_broker()
    host = broker.get("host")
    if host == LOCAL:
        shipped = shipped | {"host": LOCAL}
    foreign = [
        key
        for key, value in broker.items()
        if f"{group}.broker.{key}" not in typed and (key not in shipped or value != shipped[key])
    ]
    in_environment = os.environ.get(HOST_VARIABLE)
    is_named = f"{group}.broker.host" in typed or (
        bool(in_environment) and host in (None, in_environment)
    )
    if foreign and not is_named:
        raise ValueError(
            f"`{group}.broker.{foreign[0]}` is {broker[foreign[0]]!r} in a configuration: name the "
            f"broker's host yourself, {group}.broker.host=NAME on the command line or "
            f"export {HOST_VARIABLE}=NAME"
        )


@functools.cache
def _shipped_broker() -> dict[str, Any]:
    """Return the settings of a broker as shipped."""
    shipped = OmegaConf.to_container(OmegaConf.load(Path(CONFIGS) / "base" / "broker.yaml"))
    assert isinstance(shipped, dict)
    return {str(key): value for key, value in shipped.items()}


def _is_local(store: Any) -> bool:
    """Return whether a store as written is none or a file; an interpolation may be anything."""
    return store is None or (isinstance(store, str) and "://" not in store and "${" not in store)
