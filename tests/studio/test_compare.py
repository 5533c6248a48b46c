"""Comparison of runs: statistics against formulas and another library, groups, differences of configs."""

from __future__ import annotations

import numpy as np
import pytest

from kinetix_dist.studio.runs.compare import config_differences, group_by, group_curve, interquartile_mean


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 7, 8, 100])
def test_the_interquartile_mean_is_the_mean_of_the_middle_half(n: int) -> None:
    """Repeats each value four times: then a quarter of them is a whole number, and scipy's trimmed mean is exact."""
    from scipy.stats import trim_mean

    values = np.random.default_rng(n).normal(size=n)
    assert interquartile_mean(values) == pytest.approx(trim_mean(np.repeat(values, 4), 0.25))


def test_one_outlier_of_eight_does_not_move_it() -> None:
    assert interquartile_mean(np.array([1.0] * 7 + [1e9])) == 1.0


def test_runs_are_interpolated_within_their_rows_and_not_beyond() -> None:
    x = np.array([0.0, 10.0])
    curve = group_curve(
        [(x, np.array([0.0, 10.0])), (np.array([5.0, 10.0]), np.array([7.0, 12.0]))], statistic="mean", points=11
    )
    np.testing.assert_allclose(curve.num_runs, [1] * 5 + [2] * 6)
    assert np.isnan(curve.center[:5]).all() and np.isnan(curve.low[:5]).all(), "one of the two has no data there"
    np.testing.assert_allclose(curve.center[5:], [6, 7, 8, 9, 10, 11])
    np.testing.assert_allclose(curve.low[5:], [5, 6, 7, 8, 9, 10])
    np.testing.assert_allclose(curve.high[5:], [7, 8, 9, 10, 11, 12])


def test_the_band_of_a_mean_is_as_wide_as_its_standard_error_says() -> None:
    """30 runs of unit variance: +- 1.96 / sqrt(30)."""
    values = np.random.default_rng(1).normal(size=30)
    curve = group_curve([(np.array([0.0, 1.0]), np.full(2, v)) for v in values], statistic="mean", points=2)
    error = values.std() / np.sqrt(30)
    assert curve.high[0] - curve.low[0] == pytest.approx(2 * 1.96 * error, rel=0.1)
    assert curve.low[0] < values.mean() < curve.high[0]


def test_runs_that_agree_have_no_band() -> None:
    x = np.arange(4.0)
    same = [(x, np.array([0.1, 0.2, 0.3, 0.4])) for _ in range(3)]
    found = group_curve(same, statistic="mean", points=4)
    np.testing.assert_allclose(found.center, [0.1, 0.2, 0.3, 0.4])
    assert np.isnan(found.low).all() and np.isnan(found.high).all()
    other = [*same, (x, np.array([0.1, 0.2, 0.3, 0.9]))]
    found = group_curve(other, statistic="mean", points=4)
    assert np.isnan(found.low[:3]).all() and found.low[3] < found.center[3] < found.high[3]


def test_rows_without_a_value_are_passed_and_runs_without_any_left_out() -> None:
    x = np.arange(3.0)
    curve = group_curve([(x, np.array([1.0, np.nan, 3.0])), (x, np.full(3, np.nan))], statistic="iqm", points=3)
    np.testing.assert_allclose(curve.center, [1, 2, 3])
    assert len(group_curve([(x, np.full(3, np.nan))], statistic="mean", points=5).x) == 0


CONFIGS = {
    "a": {"ppo": {"clip": 0.2, "epochs": 1}, "run": {"seed": 0}},
    "b": {"ppo": {"clip": 0.2, "epochs": 8}, "run": {"seed": 1}},
    "c": {"ppo": {"clip": 0.2}, "run": {"seed": 0}},
}


def test_differences_of_configs() -> None:
    assert config_differences(CONFIGS) == {
        "ppo.epochs": {"a": 1, "b": 8, "c": None},
        "run.seed": {"a": 0, "b": 1, "c": 0},
    }


def test_groups_by_a_field() -> None:
    assert group_by(CONFIGS, "ppo.epochs") == {"1": ["a"], "8": ["b"], "not there": ["c"]}
    assert group_by(CONFIGS, "") == {"all": ["a", "b", "c"]}
