"""Fixtures shared by the tests: the AM96 and the protocols, as shipped."""

import gc
import os
from collections.abc import Callable

import pytest
import torch
from cli_runner import blank_figures
from composed_once import composed_once
from hypothesis import settings
from protocols import shipped_protocol
from threadpoolctl import threadpool_limits
from vehicles import AM96

from suspnet.dynamics import QuarterCar, Vehicle
from suspnet.estimation.protocols import Protocol, Task

settings.register_profile("tests", deadline=None, derandomize=True, database=None, max_examples=30)
settings.load_profile("tests")


gc.disable()  # until all tests are collected: a quarter of the time of imports and parameters


def pytest_collection_finish():
    """Let the garbage collector pass over what lives as long as the tests: modules and tests."""
    gc.collect()
    gc.freeze()
    gc.enable()


@pytest.hookimpl(wrapper=True)
def pytest_collect_file():
    """Look for no examples in the docstrings of tests: there are none, and it takes seconds."""
    return [found for found in (yield) if type(found) is pytest.Module]


def pytest_collection_modifyitems(items):
    """Give each slow test half an hour; pyproject.toml has the time limit of the others."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(1800))


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    """Two threads on a busy machine can be 30 times slower than one.

    OMP_NUM_THREADS sets another number, but for torch; processes of tests inherit it.
    """
    torch.set_num_threads(1)
    n_threads = int(os.environ.setdefault("OMP_NUM_THREADS", "1"))
    with threadpool_limits(n_threads):
        yield


@pytest.fixture(scope="session", autouse=True)
def _configurations_composed_once():
    with composed_once():
        yield


@pytest.fixture
def blank():
    with blank_figures():
        yield


@pytest.fixture(scope="session")
def am96() -> Vehicle:
    return AM96


@pytest.fixture(scope="session")
def quarter_car(am96) -> QuarterCar:
    return QuarterCar(am96)


@pytest.fixture(scope="session")
def protocol() -> Callable[..., Protocol]:
    """Build a protocol, with changes."""

    def build(name: str = "multi_location", **changes) -> Protocol:
        return shipped_protocol(name, **changes)

    return build


@pytest.fixture(scope="session")
def task(protocol) -> Callable[..., Task]:
    """Build the learning problem of one group of one protocol, with changes."""

    def build(name: str = "multi_location", group: str = "primary", **changes) -> Task:
        return protocol(name, **changes).task(group)

    return build
