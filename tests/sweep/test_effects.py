"""Main effects, against responses whose effects are known."""

import numpy as np
import pytest
from scipy import stats

from kinetix_dist.cli.sweep_tables import _interval
from kinetix_dist.sweep.effects import Error, Estimate, main_effects, mean_of_arms
from kinetix_dist.sweep.factorial import two_level_design
from tests.sweep.test_factorial import factorial, seven

TRUE = {"A": 0.30, "B": -0.10, "C": 0.0, "D": 0.05, "E": 0.0, "F": 0.0, "G": -0.02}


def response(design, effects=TRUE, interactions=()):
    """[arms]: 1/2 plus half of each effect times its sign."""
    signs = dict(zip(design.names, design.levels.T))
    values = 0.5 + sum(effect / 2 * signs[name] for name, effect in effects.items())
    return np.asarray(values) + sum(effect / 2 * signs[a] * signs[b] for a, b, effect in interactions)


def error_of(estimate: Estimate) -> Error:
    assert estimate.error is not None
    return estimate.error


def by_name(estimates):
    return {estimate.name: estimate.value for estimate in estimates}


@pytest.mark.parametrize("fold_over", [False, True])
def test_effects_without_noise_are_found_exactly(fold_over):
    design = seven(fold_over=fold_over)
    found = by_name(main_effects(design, response(design)[:, None].tolist()))
    assert found == pytest.approx(TRUE, abs=1e-12)


def test_a_fold_over_clears_main_effects_of_two_factor_interactions():
    interactions = [("A", "B", 0.08), ("C", "E", -0.04)]  # D = AB and A = CE in eight arms
    half, whole = seven(fold_over=False), seven(fold_over=True)
    confounded = by_name(main_effects(half, response(half, TRUE, interactions)[:, None].tolist()))
    assert confounded["D"] == pytest.approx(TRUE["D"] + 0.08) and confounded["A"] == pytest.approx(TRUE["A"] - 0.04)
    cleared = by_name(main_effects(whole, response(whole, TRUE, interactions)[:, None].tolist()))
    assert cleared == pytest.approx(TRUE, abs=1e-12)


def test_other_seeds_of_the_fold_over_shift_no_effect():
    design = seven(fold_over=True)
    values = response(design) + np.where(np.arange(16) < 8, 0.0, 0.2)
    found = main_effects(design, values[:, None].tolist())
    assert by_name(found) == pytest.approx(TRUE, abs=1e-12)
    assert error_of(found[0]).standard_error == pytest.approx(0.0, abs=1e-12)


def test_the_error_from_seeds_is_that_of_least_squares():
    """(X'X)^-1 s^2 of a regression of all runs, with the residual of the arms' own means."""
    design, rng = two_level_design(factorial({"A": "", "B": ""})), np.random.default_rng(3)
    values = rng.normal(size=(4, 3))
    found = main_effects(design, values.tolist())
    x = np.column_stack([np.ones(12), np.repeat(design.levels, 3, axis=0)])
    slopes = np.linalg.lstsq(x, values.ravel(), rcond=None)[0]
    residual = ((values - values.mean(axis=1, keepdims=True)) ** 2).sum() / 8
    errors = np.sqrt(np.diag(np.linalg.inv(x.T @ x)) * residual)
    for index, estimate in enumerate(found, start=1):
        assert estimate.value == pytest.approx(2 * slopes[index])  # high less low is twice the slope
        assert error_of(estimate).standard_error == pytest.approx(2 * errors[index])
        assert error_of(estimate).degrees_of_freedom == 8
        assert error_of(estimate).margin == pytest.approx(stats.t.ppf(0.975, 8) * 2 * errors[index])


def test_without_seeds_the_error_comes_from_contrasts_of_three_factors_or_more():
    design = two_level_design(factorial({"A": "", "B": "", "C": ""}))
    a, b, c = design.levels.T
    values = 0.5 + 0.15 * a + 0.1 * a * b + 0.01 * a * b * c  # contrasts are twice these
    found = main_effects(design, values[:, None].tolist())
    assert error_of(found[0]).standard_error == pytest.approx(0.02)  # not the 0.2 of a x b
    assert (error_of(found[0]).degrees_of_freedom, error_of(found[0]).source) == (1, "contrasts of 3 factors or more")


def test_where_there_are_none_of_these_it_comes_from_those_of_two():
    design = two_level_design(factorial({"A": "", "B": ""}))
    a, b = design.levels.T
    found = main_effects(design, (0.5 + 0.15 * a + 0.01 * a * b)[:, None].tolist())
    assert error_of(found[0]).standard_error == pytest.approx(0.02)
    folded = error_of(main_effects(seven(fold_over=True), np.zeros((16, 1)).tolist())[0])
    assert (folded.degrees_of_freedom, folded.source) == (7, "contrasts of two factors")


def test_a_saturated_design_has_no_error_and_says_so():
    assert all(estimate.error is None for estimate in main_effects(seven(fold_over=False), np.ones((8, 1)).tolist()))


def test_intervals_hold_the_true_effect_as_often_as_they_say():
    """800 draws of noise alone: 95 % of the intervals hold 0, by either estimate of the error (s.d. 0.8 %)."""
    rng, design = np.random.default_rng(0), seven(fold_over=True)
    for seeds in (1, 2):
        held = [
            abs(estimate.value) < error_of(estimate).margin
            for _ in range(800)
            for estimate in main_effects(design, rng.normal(size=(16, seeds)).tolist())[:1]
        ]
        assert np.mean(held) == pytest.approx(0.95, abs=0.03)


def test_arms_of_a_list_share_the_variance_within_them():
    found = mean_of_arms({"a": [1.0, 3.0], "b": [10.0, 10.0], "c": [5.0]})
    assert [estimate.value for estimate in found] == [2.0, 10.0, 5.0]
    # (1 + 1 + 0) / 2 degrees of freedom
    assert [error_of(estimate).standard_error for estimate in found] == pytest.approx([0.5**0.5, 0.5**0.5, 1.0])
    assert all(estimate.error is None for estimate in mean_of_arms({"a": [1.0], "b": [2.0]}))


def test_arms_that_are_missing_are_refused():
    with pytest.raises(ValueError, match="8 arms are needed"):
        main_effects(seven(fold_over=False), [[1.0]] * 7)


@pytest.mark.parametrize("value", [0.0, 0.1, 0.7])
def test_seeds_that_came_out_alike_have_no_interval(value):
    design = two_level_design(factorial({"A": "", "B": ""}))
    estimates = [*main_effects(design, [[value] * 3] * 4), *mean_of_arms({"a": [value] * 3, "b": [0.3] * 2})]
    for estimate in estimates:
        stored = estimate.as_json()
        assert stored["low"] is None and stored["high"] is None
        assert stored["standard_error"] == pytest.approx(0.0) and stored["error_from"]
        assert _interval(stored).endswith(f"{estimate.value:.4f} (no spread)")
    (alone,) = mean_of_arms({"a": [value]})
    assert _interval(alone.as_json()) == f"{value:.4f}"  # nothing says how large the error is


def test_seeds_that_differ_have_an_interval():
    stored = mean_of_arms({"a": [0.1, 0.2]})[0].as_json()
    low, high = stored["low"], stored["high"]
    assert isinstance(low, float) and isinstance(high, float) and low < 0.15 < high and " to " in _interval(stored)
