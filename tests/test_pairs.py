"""What is left to slow runs of a product of parametrizations holds nothing of its own."""

import itertools

import pytest
from pairs import covering, equal_steps


@pytest.mark.parametrize("together", [1, 2])
@pytest.mark.parametrize("sizes", [(2, 2, 2), (2, 3, 5), (4, 3, 2, 2, 3)])
def test_every_pair_is_held_by_few_rows(sizes, together):
    rows = [*itertools.product(*map(range, sizes))]
    kept = [rows[number] for number in covering(rows, together)]
    for some in itertools.combinations(range(len(sizes)), together):
        found = {tuple(row[k] for k in some) for row in kept}
        assert len(found) == len({tuple(row[k] for k in some) for row in rows})
    largest = sorted(sizes)[-together:]
    assert len(kept) < 2 * largest[0] * largest[-1]
    assert len(kept) < len(rows)


def test_rows_that_are_no_product_keep_each_pair_too():
    rows = [("a", 1, "x"), ("a", 2, "y"), ("b", 1, "x")]
    assert sorted(covering(rows, 2)) == [0, 1, 2]
    assert equal_steps(73, 3) == {0, 24, 48}
    assert equal_steps(2, 3) == {0, 1}
