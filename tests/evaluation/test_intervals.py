"""Wilson's interval against published values and its own definition."""

from __future__ import annotations

import math

import pytest

from kinetix_dist.evaluation.intervals import Z_95, wilson_interval


def test_interval_of_81_in_263_is_the_published_one() -> None:
    # Newcombe 1998, Statistics in Medicine 17, table I, method 3.
    low, high = wilson_interval(81, 263)
    assert (round(low, 4), round(high, 4)) == (0.2553, 0.3662)


def test_interval_of_15_in_148_is_the_published_one() -> None:
    low, high = wilson_interval(15, 148)
    assert (round(low, 4), round(high, 4)) == (0.0624, 0.1605)


def test_interval_at_the_ends_includes_zero_and_one() -> None:
    # With no success the upper end is z^2 / (n + z^2).
    low, high = wilson_interval(0, 20)
    assert low == 0.0 and high == pytest.approx(Z_95**2 / (20 + Z_95**2))
    assert wilson_interval(20, 20) == (pytest.approx(1 - high), 1.0)


@pytest.mark.parametrize(("successes", "trials"), [(1, 3), (7, 10), (50, 1000)])
def test_the_rate_is_z_standard_errors_from_either_end(successes: int, trials: int) -> None:
    rate = successes / trials
    for end in wilson_interval(successes, trials):
        assert abs(rate - end) == pytest.approx(Z_95 * math.sqrt(end * (1 - end) / trials))


def test_no_trials_tell_nothing() -> None:
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_more_successes_than_trials_are_refused() -> None:
    with pytest.raises(ValueError, match="5 successes in 3 trials"):
        wilson_interval(5, 3)
