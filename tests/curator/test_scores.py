"""Learnability p (1 - p) and the order in which levels are kept, by hand-worked cases."""

from fractions import Fraction

import jax
import numpy as np
import pytest

from kinetix_dist.curator.level_buffer import Candidates, buffer_metrics, keep_best, scored
from kinetix_dist.curator.scores import exact_keys, learnability, learnability_now, solve_rate
from tests.curator.made import stand_in


def test_a_level_that_is_never_or_always_solved_teaches_nothing():
    np.testing.assert_array_equal(learnability(np.array([0, 4]), np.array([4, 4])), [0.0, 0.0])


def test_a_level_solved_every_other_time_is_worth_a_quarter():
    assert float(learnability(np.array(3), np.array(6))) == 0.25


def test_nothing_is_claimed_of_a_level_without_a_finished_episode():
    assert float(solve_rate(np.array(0), np.array(0))) == 0.0
    assert float(learnability(np.array(0), np.array(0))) == 0.0


def _scored(candidate, solved, finished, size=4):
    """A level is its number."""
    counts = np.asarray(solved)[candidate], np.asarray(finished)[candidate]
    candidates = Candidates(candidate, *counts, np.stack([candidate], axis=1).astype(np.uint8))
    return scored(candidates, lambda index: stand_in(candidate[index]), size=size, policy_version=7)


def test_the_most_learnable_are_kept_and_ties_prefer_the_higher_solve_rate():
    buffer = keep_best([_scored(np.arange(6), [0, 1, 3, 2, 4, 1], [4, 4, 4, 4, 4, 4])], 4)
    # scores 0, 3/16, 3/16, 4/16, 0, 3/16: first the half-solved, then 3 of 4 before 1 of 4, then the lower number
    np.testing.assert_array_equal(buffer.candidate, [3, 2, 1, 5])
    np.testing.assert_array_equal(buffer.levels, [3, 2, 1, 5])
    assert int(buffer.policy_version) == 7
    metrics = buffer_metrics(buffer, 10)
    assert metrics["curriculum/buffer_age"] == 3
    assert float(metrics["curriculum/learnability"]) == pytest.approx((4 + 3 + 3 + 3) / 16 / 4)
    assert float(metrics["curriculum/mean_candidate_score"]) == pytest.approx((3 + 3 + 4 + 3) / 16 / 6)
    assert float(metrics["curriculum/learnable_share"]) == pytest.approx(4 / 6)


@pytest.mark.parametrize("num_parts", [2, 3, 7])
def test_the_same_are_kept_however_candidates_are_shared_out(num_parts):
    rng = np.random.default_rng(3)
    finished = rng.integers(0, 5, 40)
    solved = rng.integers(0, finished + 1)
    parts = [_scored(np.arange(part, 40, num_parts), solved, finished, size=12) for part in range(num_parts)]
    assert all(len(part.best) == min(12, len(part.candidate)) for part in parts)
    one, several = keep_best([_scored(np.arange(40), solved, finished, size=12)], 12), keep_best(parts, 12)
    jax.tree.map(np.testing.assert_array_equal, several, one)
    np.testing.assert_array_equal(one.levels, one.candidate)
    # By exact fractions, sorted by Python.
    p = [Fraction(int(s), max(int(f), 1)) for s, f in zip(solved, finished, strict=True)]
    order = sorted(range(40), key=lambda number: (-p[number] * (1 - p[number]), -p[number], number))
    assert one.candidate.tolist() == order[:12]


def test_equal_learnability_prefers_the_higher_solve_rate_of_any_numbers_of_episodes():
    """p (1 - p) of p and of 1 - p differ by rounding in float32: 135 pairs came in the other order."""
    finished, solved = (x.reshape(-1) for x in np.meshgrid(np.arange(65), np.arange(65), indexing="ij"))
    finished, solved = finished[solved <= finished], solved[solved <= finished]
    count = len(finished)
    p = [Fraction(int(s), max(int(f), 1)) for s, f in zip(solved, finished, strict=True)]
    order = sorted(range(count), key=lambda number: (-p[number] * (1 - p[number]), -p[number], number))
    buffer = keep_best([_scored(np.arange(count), solved, finished, size=count)], count)
    assert buffer.candidate.tolist() == order


@pytest.mark.parametrize(
    ("least", "most"), [(0, 512), (2990, 3000)]
)  # 512: scoring steps of the paper; in Python's own
def test_the_order_of_levels_is_exact_up_to_an_episode_a_scoring_step(least, most):
    finished, solved = (x.reshape(-1) for x in np.mgrid[least : most + 1, 0 : most + 1])
    finished, solved = finished[solved <= finished], solved[solved <= finished]
    learnabilities, rates = exact_keys(solved, finished)
    order = np.lexsort((np.arange(len(finished)), -rates, -learnabilities))
    s, f, divisor = (x[order].astype(object) for x in (solved, finished, np.maximum(finished, 1)))
    taught = s * (f - s)
    left, right = taught[:-1] * divisor[1:] ** 2, taught[1:] * divisor[:-1] ** 2
    assert (left >= right).all()
    rate_left, rate_right = s[:-1] * divisor[1:], s[1:] * divisor[:-1]
    assert (rate_left >= rate_right)[left == right].all()
    is_same = (left == right) & (rate_left == rate_right)
    assert (np.diff(order) > 0)[is_same].all()


def test_a_buffer_larger_than_its_candidates_is_refused():
    with pytest.raises(ValueError, match="8 levels cannot be filled from 6"):
        keep_best([_scored(np.arange(6), np.zeros(6), np.ones(6), size=8)], 8)


def test_the_interval_of_learnability_now_holds():
    """Levels of a known distribution, drawn uniformly: it covers the true mean in 95 % of 1,000 updates, and its mean
    is the true one."""
    rng = np.random.default_rng(0)
    p = np.where(rng.random(256) < 0.3, rng.choice([0.0, 1.0], 256), rng.beta(2, 2, 256))
    true, found = (p * (1 - p)).mean(), []
    for _ in range(1000):
        plays = rng.multinomial(512, np.full(256, 1 / 256))
        found.append(learnability_now(rng.binomial(plays, p), plays))
    mean, error = np.array(found).T
    # Three standard errors of 1,000 updates: .001 and .02.
    assert mean.mean() == pytest.approx(true, abs=3 * mean.std() / np.sqrt(1000))
    assert np.mean(np.abs(mean - true) < 1.96 * error) == pytest.approx(0.95, abs=0.02)


def test_nothing_is_said_of_learnability_where_no_level_was_played_twice():
    assert np.isnan(learnability_now(np.array([1, 0, 1]), np.array([1, 1, 1]))).all()
    mean, error = learnability_now(np.array([1, 0]), np.array([2, 1]))
    assert mean == 0.5 and np.isnan(error)
