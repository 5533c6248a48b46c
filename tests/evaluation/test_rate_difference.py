"""Differences of two rates against the published example and by hand."""

from __future__ import annotations

import pytest

from kinetix_dist.evaluation.paired_levels import difference_over_levels
from kinetix_dist.evaluation.rate_difference import difference_for_readers, difference_of_rates


@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        ((56, 70, 48, 80), (0.2, 0.0524, 0.3339)),
        ((9, 10, 3, 10), (0.6, 0.1705, 0.8090)),
        ((5, 56, 0, 29), (0.0893, -0.0381, 0.1926)),
        ((10, 10, 0, 10), (1.0, 0.6075, 1.0)),
    ],
)
def test_the_interval_is_that_of_table_two_of_newcombe(
    counts: tuple[int, int, int, int], expected: tuple[float, float, float]
) -> None:
    """Cases a, b, d and h of the paper, method 10."""
    found = difference_of_rates(*counts)
    assert found == pytest.approx(expected, abs=6e-5)


def test_no_attempts_have_no_difference() -> None:
    with pytest.raises(ValueError, match="0 and 4 attempts"):
        difference_of_rates(0, 0, 1, 4)


def test_levels_that_are_their_own_base_are_attempts() -> None:
    found = difference_for_readers([4, 3], 4, [1, 0], 4, ["a", "b"])
    assert found == difference_of_rates(7, 8, 1, 8)


def test_variants_of_few_base_levels_say_less() -> None:
    """Six variants of each of three base levels; one gains all, one nothing, one loses a little."""
    solved, others = [4] * 6 + [2] * 6 + [1] * 6, [0] * 6 + [2] * 6 + [2] * 6
    bases = ["a"] * 6 + ["b"] * 6 + ["c"] * 6
    found = difference_for_readers(solved, 4, others, 4, bases)
    expected = difference_over_levels([s / 4 for s in solved], [s / 4 for s in others], bases)
    over_attempts = difference_of_rates(sum(solved), 72, sum(others), 72)
    assert found == pytest.approx(expected)
    assert found.low < over_attempts.low and found.high > over_attempts.high


def test_base_levels_that_gain_alike_are_not_certain() -> None:
    found = difference_for_readers([3] * 4, 4, [1] * 4, 4, ["a", "a", "b", "b"])
    assert found == difference_of_rates(12, 16, 4, 16)
