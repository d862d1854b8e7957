"""One run of models for each direction in which trips are run."""

import pytest
from cli_runner import run_program
from test_trips_program import TRAIN

from suspnet.cli import train

QUICK = [*TRAIN, "figures=false", "data.n_train=300", "data.n_test=50", "data.n_calibrate=null"]


@pytest.mark.representatives(2)
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (["figures=false"], "direction= is for models that read trips and depend on"),
        ([*QUICK, "vehicle=sedan"], "direction= is for models that read trips and depend on"),
        ([*QUICK, "direction=back"], "`direction` must be one of"),
    ],
)
def test_direction_is_refused_where_nothing_depends_on_it(tmp_path, changes, message):
    assert message in run_program(train, tmp_path, "direction=both", *changes)
