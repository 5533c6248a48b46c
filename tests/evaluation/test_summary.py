"""Summaries of solved attempts, against sums over all draws and a simulation."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import numpy as np
import pytest

from kinetix_dist.evaluation.summary import above_random, best_of, worst_share


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_best_of_k_is_the_mean_over_all_draws_of_k_attempts(k: int) -> None:
    outcomes = [[0, 0, 0, 0], [1, 0, 0, 0], [0, 1, 1, 0], [1, 1, 1, 1]]
    draws = list(itertools.combinations(range(4), k))
    expected = np.mean([[any(level[i] for i in draw) for draw in draws] for level in outcomes])
    assert best_of([sum(level) for level in outcomes], 4, k) == pytest.approx(expected)


def test_the_worst_share_is_the_mean_of_the_lowest_rates() -> None:
    solved = [4, 0, 3, 1, 4, 4, 2, 4, 4, 4, 4]  # 11 levels: two are a tenth, rounded up
    assert worst_share(solved, 4) == pytest.approx((0 + 1) / 8)
    assert worst_share(solved, 4, share=1.0) == pytest.approx(sum(solved) / 44)
    assert worst_share([3], 4) == 0.75
    assert worst_share([0] * 5 + [4] * 95, 4, share=0.05) == 0.0  # .05 of 100 is five, whatever floats say


def test_the_worst_share_is_as_far_below_the_truth_as_documented() -> None:
    solved = np.random.default_rng(0).binomial(10, 0.5, 20_000)
    assert worst_share(solved.tolist(), 10) == pytest.approx(0.23, abs=0.01)


def test_rates_above_random_actions() -> None:
    assert above_random(0.6, 0.2) == pytest.approx(0.5)
    assert above_random(0.1, 0.2) == pytest.approx(-0.125)
    assert above_random(1.0, 1.0) is None


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: best_of([1], 2, 3), "best of 3 cannot be estimated from 2 attempts"),
        (lambda: worst_share([], 2), "no levels"),
        (lambda: worst_share([3], 2), "3 to 3 of 2 attempts"),
        (lambda: worst_share([1], 2, share=0.0), "share is 0.0"),
    ],
)
def test_what_cannot_be_is_refused(call: Callable[[], float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        call()
