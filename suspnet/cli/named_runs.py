"""The runs that `run=` names: one, a multirun, or a list of these."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from omegaconf import ListConfig

from suspnet.runs.evaluate import find_runs


def named_runs(named: Any) -> list[Path]:
    """Return the folders with a model of one run, or of a list of runs."""
    several = named if isinstance(named, ListConfig | list) else [named]
    return list(dict.fromkeys(run for one in several for run in find_runs(Path(one))))
