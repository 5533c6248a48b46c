"""MaxMC and value losses by hand, from a trajectory of 5 steps of 2 worlds."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.actors.outcomes import no_outcomes
from kinetix_dist.curator.replay_buffer import level_rates
from kinetix_dist.curator.scores import REPLAY_SCORES, UNKNOWN, summarise_values
from kinetix_dist.messages import Trajectory


@pytest.fixture(scope="module")
def outcome():
    # World 0: episodes of returns 0.5 + 1 and -1, and one that does not end. World 1: none ends.
    rewards = np.array([[0.5, 1.0, -1.0, 3.0, 3.0], [1.0] * 5], np.float32).T
    done_after = np.array([[0, 1, 1, 0, 0], [0] * 5], bool).T
    values = np.array([[0.5, 0.5, 0.0, 1.0, 0.5], [0.2] * 5], np.float32).T
    advantages = np.array([[1.0, -2.0, 0.0, 0.5, 0.5], [-1.0] * 5], np.float32).T
    none = jnp.zeros(())
    trajectory = Trajectory(
        dynamic_obs=none,
        actions=none,
        log_probs=none,
        values=jnp.asarray(values),
        rewards=jnp.asarray(rewards),
        done_after=jnp.asarray(done_after),
    )
    return dataclasses.replace(no_outcomes(2), summary=summarise_values(trajectory, jnp.asarray(advantages)))


def test_max_mc_is_the_best_return_so_far_minus_the_mean_value(outcome):
    np.testing.assert_allclose(outcome.summary.max_return, [1.5, UNKNOWN])
    score = REPLAY_SCORES["max_mc"]
    np.testing.assert_allclose(score(outcome, outcome.summary.max_return), [1.5 - 0.5, UNKNOWN])
    # An episode of another update was better: the level can be solved better than the values expect.
    np.testing.assert_allclose(score(outcome, jnp.array([2.0, 0.7])), [2.0 - 0.5, 0.7 - 0.2], rtol=1e-6)


def test_value_losses_are_means_of_advantages_those_below_zero_cut_or_turned(outcome):
    nothing = jnp.full(2, UNKNOWN)
    np.testing.assert_allclose(REPLAY_SCORES["positive_value_loss"](outcome, nothing), [2.0 / 5, 0.0])
    np.testing.assert_allclose(REPLAY_SCORES["l1_value_loss"](outcome, nothing), [4.0 / 5, 1.0])


def test_nothing_is_claimed_of_how_often_a_level_is_solved_that_no_episode_ended_on(outcome):
    rates = level_rates(jnp.zeros(2, int), jnp.array([True, False]), outcome.num_solved, outcome.num_finished, 3)
    outcome = dataclasses.replace(outcome, summary=dataclasses.replace(outcome.summary, solve_rate=rates))
    for name in ("learnability", "failure"):
        np.testing.assert_array_equal(REPLAY_SCORES[name](outcome, jnp.zeros(2)), [UNKNOWN] * 2)


def test_the_rate_of_a_level_is_the_mean_of_the_worlds_that_finished_an_episode_of_it():
    """Worlds 0 to 2 play the level of slot 1, world 3 that of slot 0, 4 and 5 fresh levels of their own."""
    slot, is_there = jnp.array([1, 1, 1, 0, 0, 0]), jnp.array([True, True, True, True, False, False])
    rates = level_rates(slot, is_there, jnp.array([1, 1, 0, 0, 2, 0]), jnp.array([1, 4, 0, 0, 4, 0]), 3)
    np.testing.assert_allclose(rates, [0.625, 0.625, 0.625, UNKNOWN, 0.5, UNKNOWN])
