"""Three sensors in the middle of a train that others simulated, on a track that gives way."""

import logging
from pathlib import Path

import numpy as np
import pytest
from cli_runner import run_program

from suspnet import PARAMETERS, load_model, read_manifest
from suspnet.cli import train

TTB2D = Path(__file__).parents[2].parent / "shared" / "ttb2d"
WORN = sorted((TTB2D / "worn").glob("*.yaml"))


@pytest.mark.slow  # a minute; test_equal_parts.py: drawn spectra of a smaller vehicle
@pytest.mark.skipif(not WORN, reason="no trips of TTB-2D here")
def test_springs_and_dampers_of_a_foreign_train_are_read(tmp_path, caplog):
    given = [f"healthy={TTB2D / 'healthy'}", "generator.frame_sensor=centre"]
    with caplog.at_level(logging.WARNING):
        assert run_program(train, tmp_path, "vehicle=manchester", "experiment=trips", *given) == 0
    assert not caplog.messages  # no doubt about sensors, directions or physics
    model = load_model(tmp_path)
    assert "track" in model.bogie.generator.parts
    assert model.bogie.misfit < 1.1
    errors, held = [], []
    for path in WORN:
        found, truth = model.estimate(path), read_manifest(path).truth
        assert found.names == PARAMETERS
        assert not found.flags.flagged[0]
        true = np.array([truth[name] for name in PARAMETERS])
        errors.append(100 * np.log(found.values[0] / true))
        held.append((found.low[0] < true) & (true < found.high[0]))
    # rms k_p .07, c_p .72, k_s .14, c_s .15, M_s .47 % and 24 of 25 held when written; the
    # curve fit of G_p and G_s that knew no track had .32, 2.6, .76, .87 and 1.1 %
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert (rms < [0.25, 1.6, 0.4, 0.3, 1.0]).all()
    assert np.mean(held) > 0.75
