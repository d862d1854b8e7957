"""Which cases of a test run by default; all run with `-m ""`."""

import itertools
from collections import defaultdict

import pytest


def mark_beyond_pairs(items):
    """Mark as slow the cases of three or more factors whose pairs of values others hold.

    Where a test is marked `every_value`, they are the cases whose values others hold; where it
    is marked `representatives(n)`, all cases but the first and others at equal steps, n in all.
    """
    functions = defaultdict(list)
    for item in items:
        if hasattr(item, "callspec") and not item.get_closest_marker("slow"):
            functions[item.nodeid.partition("[")[0]].append(item)
    for cases in functions.values():
        marked = cases[0].get_closest_marker("representatives")
        if marked:
            _mark_slow(cases, equal_steps(len(cases), *marked.args))
            continue
        rows = _rows(cases)
        together = 1 if cases[0].get_closest_marker("every_value") else 2
        if len(rows[0]) <= together:
            continue
        _mark_slow(cases, set(covering(rows, together)))


def _mark_slow(cases, kept):
    """Mark the cases as slow whose numbers are not among those kept."""
    for number, item in enumerate(cases):
        if number not in kept:
            item.add_marker(pytest.mark.slow)


def equal_steps(n_cases, n_kept):
    """Return the numbers of so many of the cases at equal steps, the first one among them."""
    n_kept = min(n_kept, n_cases)
    return {number * n_cases // n_kept for number in range(n_kept)}


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
