"""Fixtures shared by the tests: the AM96 vehicle and the paper's protocols."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import settings

from suspnet.data import Protocol, Task
from suspnet.dynamics import QuarterCar, Vehicle

settings.register_profile("tests", deadline=None, derandomize=True, database=None, max_examples=30)
settings.load_profile("tests")

BOTH = {
    "responses": ["G_p", "G_s"],
    "peaks": ["secondary", "primary_lower", "primary_upper"],
}
GROUPS = {  # as in configs/protocol/*.yaml
    "paper": {
        "primary": {
            "outputs": ["k_p", "c_p"],
            "responses": ["G_p"],
            "peaks": ["primary_largest"],
        },
        "secondary": {"outputs": ["k_s", "c_s"], "responses": ["G_s"], "peaks": ["secondary"]},
    },
    "multi_location": {
        "primary": {"outputs": ["k_p", "c_p"], **BOTH},
        "secondary": {"outputs": ["k_s", "c_s"], **BOTH},
    },
    "joint": {"all": {"outputs": ["k_p", "c_p", "k_s", "c_s"], **BOTH}},
}


def pytest_collection_modifyitems(items):
    """Give each slow test half an hour; pyproject.toml has the time limit of the others."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(1800))


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread():
    """Two threads on a busy machine can be 30 times slower than one."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def am96() -> Vehicle:
    """Table III of the paper, units corrected."""
    return Vehicle("am96", 1725.0, 6300.0, 1.30e6, 3.7e3, 0.69e6, 22.6e3)


@pytest.fixture(scope="session")
def quarter_car(am96) -> QuarterCar:
    return QuarterCar(am96)


@pytest.fixture(scope="session")
def protocol() -> Callable[..., Protocol]:
    """Build one of the three protocols, with changes."""

    def build(name: str = "multi_location", **changes) -> Protocol:
        sampling = "sobol" if name == "joint" else "grid"
        return Protocol(name, **({"groups": GROUPS[name], "sampling": sampling} | changes))

    return build


@pytest.fixture(scope="session")
def task(protocol) -> Callable[..., Task]:
    """Build the learning problem of one group of one protocol, with changes."""

    def build(name: str = "multi_location", group: str = "primary", **changes) -> Task:
        return protocol(name, **changes).task(group)

    return build
