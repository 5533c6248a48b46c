"""Intervals over seeds, and of paired differences over levels."""

import numpy as np
import pytest

from kinetix_dist.evaluation.over_seeds import (
    bootstrap_difference,
    bootstrap_interval,
    iqm,
    mean,
    welch_interval,
)
from kinetix_dist.evaluation.paired_levels import difference_over_levels


def test_the_iqm_is_the_mean_of_the_middle_half():
    assert float(iqm(np.array([0.0, 1.0, 3.0, 100.0]))) == pytest.approx(2.0)
    assert float(iqm(np.arange(8.0))) == pytest.approx((2 + 3 + 4 + 5) / 4)
    # Of three seeds the middle one counts in full, a third, the others from a quarter to a third each.
    assert float(iqm(np.array([0.0, 3.0, 30.0]))) == pytest.approx((0.0 / 12 + 3.0 / 3 + 30.0 / 12) * 2)
    assert float(iqm(np.array([5.0]))) == pytest.approx(5.0) and float(iqm(np.array([1.0, 2.0]))) == pytest.approx(1.5)


def test_the_iqm_is_taken_row_by_row():
    rows = np.array([[4.0, 0.0, 100.0, 2.0], [1.0, 1.0, 1.0, 1.0]])
    np.testing.assert_allclose(iqm(rows), [3.0, 1.0])


def test_one_seed_has_no_interval():
    assert bootstrap_interval([0.5]) is None
    assert bootstrap_difference([0.5], [0.1, 0.2]) is None and welch_interval([0.1, 0.2], [0.5]) is None


@pytest.mark.parametrize("value", [0.0, 0.1, 0.5, 0.7, 1.0])
@pytest.mark.parametrize("count", [2, 3, 7, 20])
def test_equal_values_have_no_interval(value, count):
    values, others = [value] * count, [0.3] * (count + 1)
    assert bootstrap_interval(values) is None and bootstrap_interval(values, iqm) is None
    assert bootstrap_difference(values, others) is None and bootstrap_difference(values, others, iqm) is None
    assert welch_interval(values, others) is None


def test_a_difference_has_an_interval_where_one_of_two_arms_has_spread():
    assert bootstrap_difference([0.5, 0.5], [0.2, 0.3]) == pytest.approx((0.2, 0.3))
    interval = welch_interval([0.5, 0.5], [0.2, 0.3])
    assert interval is not None and interval[0] < 0.25 < interval[1]


def test_the_interval_of_few_seeds_ends_at_the_extremes_and_is_repeated():
    assert bootstrap_interval([0.1, 0.2, 0.6]) == pytest.approx((0.1, 0.6))
    assert bootstrap_interval([0.1, 0.2, 0.6]) == bootstrap_interval([0.1, 0.2, 0.6])
    assert bootstrap_difference([0.5, 0.6], [0.1, 0.2]) == pytest.approx((0.3, 0.5))


def test_welchs_interval_is_that_of_the_books():
    # scipy.stats.ttest_ind([1, 2, 3, 4], [2, 4, 6], equal_var=False).confidence_interval()
    from scipy.stats import ttest_ind

    expected = ttest_ind([1, 2, 3, 4], [2, 4, 6], equal_var=False).confidence_interval()
    assert welch_interval([1, 2, 3, 4], [2, 4, 6]) == pytest.approx((expected.low, expected.high))


def holds(value: float, interval: tuple[float, float] | None) -> bool:
    assert interval is not None
    return interval[0] <= value <= interval[1]


@pytest.mark.parametrize(("num_seeds", "least", "most"), [(3, 0.60, 0.85), (20, 0.90, 0.97)])
def test_bootstrap_intervals_hold_the_true_mean_less_often_the_fewer_seeds(num_seeds, least, most):
    random = np.random.default_rng(3)
    values = random.normal(0.4, 0.1, (300, num_seeds))
    held = [holds(0.4, bootstrap_interval(row, mean)) for row in values]
    assert least <= np.mean(held) <= most


def test_welchs_intervals_hold_the_true_difference_with_three_seeds():
    random = np.random.default_rng(4)
    ours, theirs = random.normal(0.5, 0.02, (400, 3)), random.normal(0.4, 0.05, (400, 3))
    held = [holds(0.1, interval) for interval in map(welch_interval, ours, theirs)]
    assert 0.92 <= np.mean(held) <= 0.99  # 95 %; standard error of 400 draws: 1.1 %


# On the same levels


@pytest.mark.parametrize("gain", [0.0, 0.1, 0.3])
def test_levels_that_differ_alike_say_nothing_of_others(gain):
    rates = [0.7, 0.0, 0.2] * 20
    assert difference_over_levels([rate + gain for rate in rates], rates, [str(i) for i in range(60)]) is None


def test_the_difference_of_levels_is_paired():
    """Students' t of the differences of levels, by hand."""
    rates, others = [0.9, 0.5, 0.4, 0.2], [0.8, 0.5, 0.1, 0.2]
    found = difference_over_levels(rates, others, list("abcd"))
    margin = 3.182446 * np.std([0.1, 0.0, 0.3, 0.0], ddof=1) / 2  # t of 3 degrees of freedom, 97.5 %
    assert found == pytest.approx((0.1, 0.1 - margin, 0.1 + margin))


def test_variants_of_one_level_are_one_observation():
    rates, others = [1.0, 0.2, 0.6], [0.0, 0.1, 0.1]
    alone = difference_over_levels(rates, others, list("abc"))
    repeated = difference_over_levels(rates * 8, others * 8, list("abc") * 8)
    assert repeated == pytest.approx(alone)
    assert difference_over_levels(rates, others, list("aaa")) is None
