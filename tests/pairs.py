"""Products of parametrizations: all pairs of values by default, all combinations with `-m ""`."""

import itertools
from collections import defaultdict

import pytest


def mark_beyond_pairs(items):
    """Mark as slow the cases of three or more factors whose pairs of values others hold.

    Where a test is marked `every_value`, they are the cases whose values others hold.
    """
    functions = defaultdict(list)
    for item in items:
        if hasattr(item, "callspec") and not item.get_closest_marker("slow"):
            functions[item.nodeid.partition("[")[0]].append(item)
    for cases in functions.values():
        rows = _rows(cases)
        together = 1 if cases[0].get_closest_marker("every_value") else 2
        if len(rows[0]) <= together:
            continue
        kept = set(covering(rows, together))
        for number, item in enumerate(cases):
            if number not in kept:
                item.add_marker(pytest.mark.slow)


def _rows(cases):
    """Return what each case takes of each factor that takes more than one value."""
    together = [
        tuple(name.strip() for name in names.split(",")) if isinstance(names, str) else tuple(names)
        for names in (mark.args[0] for mark in cases[0].iter_markers("parametrize"))
    ]
    others = cases[0].callspec.params.keys() - {name for names in together for name in names}
    factors = together + [(name,) for name in sorted(others)]
    columns = [
        [tuple(id(case.callspec.params.get(name)) for name in names) for case in cases]
        for names in factors
    ]
    return list(zip(*(c for c in columns if len(set(c)) > 1), strict=True)) or [()] * len(cases)


def covering(rows, together):
    """Yield rows that together hold all pairs, or values: next the one with most of the rest."""
    held = [set(itertools.combinations(enumerate(row), together)) for row in rows]
    left = set().union(*held)
    while left:  # ends: each turn takes one at least
        best = max(range(len(rows)), key=lambda number: len(held[number] & left))
        left -= held[best]
        yield best
