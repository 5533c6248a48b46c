"""Wilson's interval against published values and its own definition."""

from __future__ import annotations

import math

import numpy as np
import pytest

from kinetix_dist.evaluation.intervals import (
    Z_95,
    difference_interval,
    for_readers,
    interval_over_levels,
    t_95,
    wilson_interval,
    z_95,
)
from kinetix_dist.evaluation.paired_levels import difference_over_levels
from kinetix_dist.level.level_data import base_levels, variant_name
from kinetix_dist.level.variants import NUM_VARIANTS


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


@pytest.mark.parametrize(
    ("num_base", "variants", "attempts"),
    [
        pytest.param(10, 8, 4, id="sets of variants: ten base levels"),
        pytest.param(40, 8, 2, id="and forty"),
        pytest.param(60, 1, 4, id="random levels"),
        pytest.param(60, 1, 1, id="of one attempt: binomial"),
    ],
)
def test_the_interval_over_levels_holds_the_rate_on_levels_like_these(
    num_base: int, variants: int, attempts: int
) -> None:
    """Base levels with known chances: most are solved hardly ever or nearly always; their variants are like them."""
    rng, repeats = np.random.default_rng(0), 800
    a, b = 0.4, 0.6
    base = rng.beta(a, b, (repeats, num_base, 1))
    p = np.clip(base + rng.normal(0.0, 0.05, (repeats, num_base, variants)), 0.0, 1.0) if variants > 1 else base
    truth = p.mean() if variants > 1 else a / (a + b)
    solved = rng.binomial(attempts, p).reshape(repeats, -1)
    names = [f"level_{level}" for level in range(num_base) for _ in range(variants)]
    over = [interval_over_levels(counts.tolist(), attempts, names) for counts in solved]
    covered = np.mean([found is not None and found["low"] <= truth <= found["high"] for found in over])
    assert 0.92 < covered < 0.98
    trials = solved.shape[1] * attempts
    by_attempts = [wilson_interval(int(counts.sum()), trials) for counts in solved]
    covered_by_attempts = np.mean([low <= truth <= high for low, high in by_attempts])
    if variants > 1:
        assert covered_by_attempts < 0.5  # the interval that was printed with such sets
    if attempts == variants == 1:
        assert np.mean([found["high"] - found["low"] for found in over if found]) == pytest.approx(
            np.mean([high - low for low, high in by_attempts]), rel=0.05
        )


@pytest.mark.parametrize(("num_levels", "never"), [(20, 0.05), (74, 0.02), (10, 0.1)])
def test_intervals_over_levels_hold_where_all_but_a_few_levels_are_always_solved(num_levels: int, never: float) -> None:
    """A sample may hold none of the few levels that no policy solves, or one attempt of all that fails."""
    rng = np.random.default_rng(0)
    solved = 20 * (rng.random((800, num_levels)) >= never)
    names = [str(level) for level in range(num_levels)]
    over = [interval_over_levels(counts.tolist(), 20, names) for counts in solved]
    assert np.mean([found is not None and found["low"] <= 1 - never <= found["high"] for found in over]) > 0.93


def test_intervals_over_levels_at_the_ends_are_those_of_as_many_trials_as_base_levels() -> None:
    names = [f"level_{i // 8}" for i in range(80)]
    found = interval_over_levels([0] * 80, 4, names)
    assert found is not None and (found["low"], found["base_levels"], found["levels"]) == (0.0, 10, 80)
    t = 2.2621571628  # 97.5 % quantile of Student's t with 9 degrees of freedom
    assert found["high"] == pytest.approx(t**2 / (10 + t**2))
    assert interval_over_levels([3] * 8, 4, ["level"] * 8) is None  # says nothing of other levels
    with pytest.raises(ValueError, match="of 4 attempts cannot have solved"):
        interval_over_levels([5, 1], 4, ["a", "b"])


def test_sets_of_variants_are_shown_with_the_interval_over_their_base_levels() -> None:
    over = {"low": 0.1, "high": 0.9, "base_levels": 10, "levels": 80}
    rate = {"low": 0.4, "high": 0.5, "interval_over_levels": over}
    assert for_readers(rate) == (0.1, 0.9)
    assert for_readers(rate | {"interval_over_levels": over | {"base_levels": 80}}) == (0.4, 0.5)
    assert for_readers({"low": 0.4, "high": 0.5}) == (0.4, 0.5)  # of an older run


def test_variants_of_a_level_count_as_one_base_level() -> None:
    names = [variant_name(level, number) for level in ("hop_home", "kick_2") for number in range(NUM_VARIANTS)]
    assert base_levels("dev_designed_s", names) == ["hop_home"] * 8 + ["kick_2"] * 8
    assert base_levels("random_s", ["random_s_0", "random_s_1"]) == ["random_s_0", "random_s_1"]


def test_a_difference_of_two_rates_against_the_published_examples() -> None:
    """R. G. Newcombe 1998, table II, method 10: (a) 56 of 70 and 48 of 80, (h) 10 of 10 and 0 of 10."""

    def difference(solved: int, attempts: int, other: int, other_attempts: int) -> tuple[float, float, float]:
        one, two = ((k / n, *wilson_interval(k, n)) for k, n in ((solved, attempts), (other, other_attempts)))
        return difference_interval(one, two)

    assert difference(56, 70, 48, 80) == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)
    assert difference(10, 10, 0, 10) == pytest.approx((1.0, 0.6075, 1.0), abs=1e-4)


def test_several_comparisons_at_once_have_wider_intervals() -> None:
    assert z_95() == pytest.approx(Z_95) and z_95(5) == pytest.approx(2.5758, abs=1e-4), "1 % two-sided"
    assert t_95(9) == pytest.approx(2.2622, abs=1e-4) and t_95(9, 5) == pytest.approx(3.2498, abs=1e-4)
    alone = difference_over_levels([0.5, 0.6, 0.9], [0.4, 0.4, 0.6], ["a", "b", "c"])
    many = difference_over_levels([0.5, 0.6, 0.9], [0.4, 0.4, 0.6], ["a", "b", "c"], comparisons=10)
    assert alone is not None and many is not None and many[1] < alone[1] < alone[0] < alone[2] < many[2]
