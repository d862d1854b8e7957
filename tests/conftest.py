"""Fixtures shared by the tests: the AM96 and the protocols, as shipped.

Fixtures import what they need: the process that hands out tests to others needs no torch.
"""

import ctypes
import gc
import os
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

import built_once
import pytest
from hypothesis import settings
from pairs import mark_beyond_pairs

if TYPE_CHECKING:
    from suspnet.curves.protocols import Protocol, Task
    from suspnet.vehicle import QuarterCar, Vehicle

settings.register_profile("tests", deadline=None, derandomize=True, database=None, max_examples=20)
settings.load_profile("tests")


gc.disable()  # until all tests are collected: a quarter of the time of imports and parameters

# What one process compiles, all others read. Where the environment forbids to write it, each of
# them compiles 570 modules, which is half the time of its start.
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


def pytest_collection_finish():
    """Let the garbage collector pass over what lives as long as the tests: modules and tests."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_collect_file():
    """Look for no examples in the docstrings of tests: there are none, and it takes seconds."""
    return [found for found in (yield) if type(found) is pytest.Module]


@pytest.hookimpl(tryfirst=True)  # before those that are slow are left out
def pytest_collection_modifyitems(items):
    """Leave large products to slow runs, and give each slow test half an hour.

    pyproject.toml has the time limit of the others.
    """
    mark_beyond_pairs(items)
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(1800))


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    """Two threads on a busy machine can be 30 times slower than one.

    OMP_NUM_THREADS sets another number, but for torch; processes of tests inherit it.
    """
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    n_threads = int(os.environ.setdefault("OMP_NUM_THREADS", "1"))
    with threadpool_limits(n_threads):
        yield


@pytest.fixture(scope="session", autouse=True)
def _libraries_looked_for_once(_one_thread):
    """Look once for the libraries whose threads are limited: each trip and each fit asks for it."""
    from threadpoolctl import ThreadpoolController

    from suspnet.ground import tensors

    found = ThreadpoolController()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tensors, "threadpool_limits", lambda number: found.limit(limits=number))
        yield


@pytest.fixture(scope="session", autouse=True)
def _memory_kept():
    """Keep freed memory in the process: to get it from the kernel again takes a twentieth."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # of the GNU C library
    if mallopt is not None:
        mallopt(-3, 32 << 20)  # M_MMAP_THRESHOLD
        mallopt(-1, 512 << 20)  # M_TRIM_THRESHOLD


@pytest.fixture(scope="session", autouse=True)
def _nothing_forced_to_the_disk():
    """Leave it to the kernel when files are written: each wait for the disk takes some ms."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def _workers_forked():
    """Fork the workers of all pools, as programs do, from the server that forks programs."""
    from forked import forks

    from suspnet.ground import workers

    forks()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(workers, "start_method", "forkserver")
        patch.setattr(workers, "fork_from_server", lambda *_: None)  # the server imports more
        yield


@pytest.fixture(scope="session", autouse=True)
def _built_in_one_folder(tmp_path_factory):
    """Name the folder of what the processes of this run build for each other."""
    root = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        root = root.parent
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(built_once.FOLDER, str(root / "built"))
        yield


READ_APART = ("tests",)
"""Folders whose tests read every file as users do, in a process of its own."""
APART = ("attacks", "bounds", "confinement", "formats", "fuzz", "memory", "process")
"""Ends of names of modules of recordings that do so too."""


@pytest.fixture(scope="module", autouse=True)
def _parquet_read_in_this_process(request):
    """Read simulated trips without a process for each of their four files, a third of the time."""
    from suspnet.trains.recordings import formats

    name, folder = request.path.stem, request.path.parent.name
    apart = folder in READ_APART or name == "test_same_estimate"
    apart |= folder == "recordings" and name.endswith(APART)
    as_users_do = formats.READERS[".parquet"]
    with pytest.MonkeyPatch.context() as patch:
        if not apart:
            patch.setitem(formats.READERS, ".parquet", formats.open_parquet)
        yield as_users_do


@pytest.fixture(scope="session", autouse=True)
def _configurations_composed_once():
    from composed_once import composed_once

    with composed_once():
        yield


@pytest.fixture(scope="module")
def healthy_trips_read_once():
    """Read the recording of a healthy trip, under whatever name, once in a module."""
    from dataclasses import replace
    from pathlib import Path

    from suspnet.trains.identification import healthy_trips

    load, known = healthy_trips.load_recording, {}

    def loaded(manifest, *others):
        key = repr((replace(manifest, path=Path(), name=""), others))
        if key not in known:
            known[key] = load(manifest, *others)
        return replace(known[key], manifest=manifest)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(healthy_trips, "load_recording", loaded)
        yield


@pytest.fixture(scope="session", autouse=True)
def _sensors_looked_for_once():
    """Look for the sensors of the same spectra once in a process: it takes half of a check.

    tests/identification/test_sensor_places.py looks for those that are not in their place.
    """
    from suspnet.trains.identification import healthy_trips
    from suspnet.trains.trips import sensor_checks

    look, known = healthy_trips.elsewhere, {}

    def looked(generator, settings, trip, direction):
        numbers = trip.spectra.cross.numpy().tobytes(), trip.spectra.n_averages
        key = repr((generator, settings, trip.speeds, trip.left_out, direction)), numbers
        if key not in known:
            known[key] = look(generator, settings, trip, direction)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        for module in (healthy_trips, sensor_checks):
            patch.setattr(module, "elsewhere", looked)
        yield


@pytest.fixture(scope="module")
def trips_fitted_once():
    """Fit the same trips once for all boards of a module, which is most of the time of a view."""
    import pickle

    from suspnet.trains.maintenance import state

    known, predict = {}, state.predict_life

    def once(*given, **options):
        key = pickle.dumps((given, options))
        if key not in known:
            known[key] = predict(*given, **options)
        return known[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(state, "predict_life", once)
        yield


@pytest.fixture
def blank():
    from cli_runner import blank_figures

    with blank_figures():
        yield


@pytest.fixture(scope="session")
def am96() -> "Vehicle":
    from vehicles import AM96

    return AM96


@pytest.fixture(scope="session")
def quarter_car(am96) -> "QuarterCar":
    from suspnet.vehicle import QuarterCar

    return QuarterCar(am96)


@pytest.fixture(scope="session")
def protocol() -> "Callable[..., Protocol]":
    """Build a protocol, with changes."""
    from protocols import shipped_protocol

    def build(name: str = "multi_location", **changes) -> "Protocol":
        return shipped_protocol(name, **changes)

    return build


@pytest.fixture(scope="session")
def task(protocol) -> "Callable[..., Task]":
    """Build the learning problem of one group of one protocol, with changes."""

    def build(name: str = "multi_location", group: str = "primary", **changes) -> "Task":
        return protocol(name, **changes).task(group)

    return build
