"""Ablations: runs that differ from a baseline in one setting, as records and as tables."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from tabulate import tabulate

from suspnet.runs.table6 import in_digits, mean_known

BASELINE = "baseline"
"""Name of the ablation that changes nothing."""
IGNORED = ("ablation_name",)
PARTS = ("protocol", "data", "model")
"""Order in which settings are listed, by the first word of their key."""

Record = dict[str, Any]


def flattened(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return a nested mapping as one from dotted keys to values.

    Examples
    --------
    >>> flattened({"model": {"C": 1.0, "callback": None}, "seed": 0})
    {'model.C': 1.0, 'model.callback': None, 'seed': 0}
    """
    flat: dict[str, Any] = {}
    for key, value in config.items():
        if isinstance(value, Mapping) and value:
            flat |= flattened(value, f"{prefix}{key}.")
        else:
            flat[f"{prefix}{key}"] = value
    return flat


def changes(config: Mapping[str, Any], baseline: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a run that are not the baseline's, as a user would override them.

    Parameters
    ----------
    config, baseline : mappings
        The resolved configurations of both.
    """
    before, after = flattened(baseline), flattened(config)
    changed = {
        key: value
        for key, value in after.items()
        if key not in IGNORED and (key not in before or before[key] != value)
    }
    return {key: changed[key] for key in sorted(changed, key=_place)}


def ablation_records(runs: Sequence[Mapping[str, Any]]) -> list[Record]:
    """Return one record for each output of each run.

    Parameters
    ----------
    runs : sequence of mappings
        The metrics.json of each run with two keys more: `config`, its resolved configuration, and
        `features_ratio`, {output: rms bound of its features over that of its curves}.

    Returns
    -------
    list of dict
        Keys protocol, group, ablation, change, output, rms_ratio (rms error over the bound of the
        curves), to_baseline (that over the baseline's), features_ratio, mape_percent, bound (the
        MAPE at the bound), lost_percent (test curves that lack a feature), n_train, snr_db, seed,
        seconds. The baseline comes first in its group, then settings in a fixed order; without a
        baseline of the same protocol, group and seed, `change` and `to_baseline` are None.
    """
    baselines = {_setting(run): run for run in runs if run["ablation"] == BASELINE}
    ordered = []
    for run in runs:
        baseline = baselines.get(_setting(run))
        changed = None if baseline is None else changes(run["config"], baseline["config"])
        ordered.append((_order(run, changed), _records(run, baseline, changed)))
    ordered.sort(key=lambda pair: pair[0])
    return [record for _, records in ordered for record in records]


def ablation_markdown(records: Sequence[Record]) -> str:
    """Return the records of one protocol and group as Markdown, averaged over seeds."""
    outputs = list(dict.fromkeys(r["output"] for r in records))
    rows = []
    for name in dict.fromkeys(r["ablation"] for r in records):
        same = [r for r in records if r["ablation"] == name]
        row = [name]
        for output in outputs:
            chosen = [r for r in same if r["output"] == output]
            for key in ("rms_ratio", "to_baseline", "features_ratio", "mape_percent"):
                row.append(in_digits(mean_known(r[key] for r in chosen)))
        row += [in_digits(mean_known(r[key] for r in same)) for key in ("lost_percent", "seconds")]
        rows.append([*row, same[0]["change"] or ("" if name == BASELINE else "-")])
    header = ["ablation"]
    for output in outputs:
        header += [output, "x", "features", "MAPE %"]
    header += ["lost %", "seconds", "change"]
    return tabulate(rows, header, tablefmt="github", disable_numparse=True)


def ablation_caption(records: Sequence[Record]) -> str:
    """Return in words what a table of one protocol and group shows."""
    first = next((r for r in records if r["ablation"] == BASELINE), records[0])
    seeds = ", ".join(str(seed) for seed in sorted({r["seed"] for r in records}))
    return (
        f"protocol {first['protocol']}, group {first['group']}, {first['n_train']} training "
        f"curves, {first['snr_db']:g} dB and seed {seeds} unless the change says otherwise.\n"
        "Below each output: rms error over the Cramer-Rao bound of the curves; x: that over the "
        "baseline's;\nfeatures: the bound of the features over that of the curves, which no "
        "unbiased regression on these features\npasses; MAPE. lost: test curves that lack a "
        "feature; seconds: to fit and predict."
    )


def _records(
    run: Mapping[str, Any], baseline: Mapping[str, Any] | None, changed: Mapping[str, Any] | None
) -> list[Record]:
    """Return the records of one run, one for each output."""
    told = None
    if changed is not None:
        told = " ".join(f"{key}={_shown(value)}" for key, value in changed.items())
    usual = {} if baseline is None else baseline["rms_ratio"]
    return [
        {
            "protocol": run["protocol"],
            "group": run["group"],
            "ablation": run["ablation"],
            "change": told,
            "output": output,
            "rms_ratio": ratio,
            "to_baseline": _over(ratio, usual.get(output)),
            "features_ratio": run["features_ratio"].get(output),
            "mape_percent": run["scores"][output]["mape_percent"],
            "bound": run["bound"][output]["mape_percent"],
            "lost_percent": 100 * (1 - run["n_test_complete"] / run["n_test"]),
            "n_train": run["n_train"],
            "snr_db": run["snr_db"],
            "seed": run["seed"],
            "seconds": run["seconds"],
        }
        for output, ratio in run["rms_ratio"].items()
    ]


def _setting(run: Mapping[str, Any]) -> tuple[Any, ...]:
    """Return what a run shares with its baseline."""
    return run["protocol"], run["group"], run["seed"]


def _order(run: Mapping[str, Any], changed: Mapping[str, Any] | None) -> tuple[Any, ...]:
    """Return the sorting key of a run: group, the baseline first, then settings and values."""
    places = [(*_place(key), *_rank(value)) for key, value in (changed or {}).items()]
    is_other = run["ablation"] != BASELINE
    return run["protocol"], run["group"], is_other, places, run["ablation"], run["seed"]


def _place(key: str) -> tuple[int, str]:
    """Return the sorting key of a setting's name."""
    first = key.split(".")[0]
    return (PARTS.index(first) if first in PARTS else len(PARTS), key)


def _rank(value: Any) -> tuple[float, str]:
    """Return the sorting key of a setting's value."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return (float(value) if number else 0.0, str(value))


def _shown(value: Any) -> str:
    """Return a value as it is written on the command line."""
    if isinstance(value, float):
        return f"{value:g}"
    return value if isinstance(value, str) else json.dumps(value)


def _over(value: float | None, other: float | None) -> float | None:
    """Return a quotient, None if a part is missing or 0."""
    return None if value is None or not other else value / other
