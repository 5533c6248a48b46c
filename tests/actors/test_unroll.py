"""Rollouts of the real environment with a tiny network: what is stored, and on what samples may not depend."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from jax2d.scene import stack_worlds
from kinetix_dist.actors.outcomes import PHYSICS_FIELDS, add_step, no_outcomes
from kinetix_dist.actors.unroll import Worlds, score, unroll
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.learner.sharding import DATA_AXIS, data_mesh
from kinetix_dist.level.level import Level
from kinetix_dist.level.schema import load_level
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy
from tests.helpers import REPOSITORY

STEPS, EPISODE = 12, 5
POLICY = PolicyConfig(encoder_size=8, attention_features=4, num_heads=4, num_layers=1, hidden_size=8, hidden_layers=1)


@dataclasses.dataclass(frozen=True)
class Problem:
    env: Environment
    policy: Any
    params: Any
    levels: Level
    play: Callable[..., Any]  # (levels, key, first world) -> what unroll returns

    @property
    def num_worlds(self) -> int:
        return self.levels.position.shape[0]


@pytest.fixture(scope="module")
def problem():
    files = sorted((REPOSITORY / "levels" / "s").glob("*.json"))[:2]
    levels = stack_worlds([load_level(path)[0] for path in files] * 2)
    env = Environment(EnvConfig(size="s", max_steps=EPISODE))
    policy = make_policy(POLICY, env.action_distribution.head_sizes)
    prepared = env.prepare(levels)
    params = init_params(policy, jax.jit(env.observe)(prepared, prepared.initial_obs), jax.random.key(0))

    @jax.jit
    def play(levels, key, first_world):
        prepared = env.prepare(levels)
        numbers = first_world + jnp.arange(levels.position.shape[0])
        return unroll(policy, params, env, Worlds(prepared, *env.reset(prepared), numbers), key, STEPS)

    return Problem(env, policy, params, levels, play)


def test_stored_probabilities_and_values_are_those_of_the_stored_observations(problem):
    trajectory, _, obs, _, last_value, _ = problem.play(problem.levels, jax.random.key(1), 0)
    prepared = problem.env.prepare(problem.levels)
    observe, apply = jax.jit(problem.env.observe), jax.jit(problem.policy.apply)
    log_probs_of = jax.jit(problem.env.action_distribution.log_prob_and_entropy)
    for step in (0, STEPS - 1):
        seen = observe(prepared, jax.tree.map(lambda x, step=step: x[step], trajectory.dynamic_obs))
        logits, value = apply(problem.params, seen)
        np.testing.assert_allclose(trajectory.values[step], value, atol=1e-5)  # float32, another fusion
        log_probs, _ = log_probs_of(logits, trajectory.actions[step])
        np.testing.assert_allclose(trajectory.log_probs[step], log_probs, atol=1e-5)
    np.testing.assert_allclose(last_value, apply(problem.params, observe(prepared, obs))[1], atol=1e-5)
    assert trajectory.actions.dtype == jnp.int8
    assert trajectory.actions.shape == (STEPS, problem.num_worlds, 6)


def test_outcomes_count_the_episodes_that_ended(problem):
    trajectory, *_, outcome = problem.play(problem.levels, jax.random.key(1), 0)
    np.testing.assert_array_equal(outcome.num_finished, trajectory.done_after.sum(axis=0))
    assert np.all(outcome.num_finished >= STEPS // EPISODE)
    assert np.all(outcome.num_solved <= outcome.num_finished)
    # STEPS are more than an episode has, so that the first one of every world is over.
    done, rewards = np.asarray(trajectory.done_after), np.asarray(trajectory.rewards)
    is_first = np.cumsum(done, axis=0) - done == 0
    np.testing.assert_allclose(outcome.first_return, np.where(is_first, rewards, 0.0).sum(axis=0), atol=1e-5)
    ends = (rewards * (is_first & done)).sum(axis=0)  # 1 for what is solved, -1 for what failed, beside dense reward
    np.testing.assert_array_equal(outcome.first_solved, ends > 0.5)
    np.testing.assert_array_equal(outcome.first_failed, ends < -0.5)
    # Rewards up to the last end belong to finished episodes.
    counted = np.cumsum(np.asarray(trajectory.done_after)[::-1], axis=0)[::-1] > 0
    returns = np.where(counted, trajectory.rewards, 0.0).sum(axis=0)
    np.testing.assert_allclose(outcome.return_sum, returns, atol=1e-5)
    np.testing.assert_array_equal(outcome.length_sum, counted.sum(axis=0))


def test_scoring_gives_the_outcomes_of_the_same_rollout(problem):
    prepared = problem.env.prepare(problem.levels)
    scored = jax.jit(lambda key: score(problem.policy, problem.params, problem.env, prepared, key, STEPS))
    expected = problem.play(problem.levels, jax.random.key(1), 0)[-1]
    jax.tree.map(np.testing.assert_array_equal, scored(jax.random.key(1)), expected)


def test_equal_worlds_act_differently_and_keys_matter(problem):
    trajectory = problem.play(problem.levels, jax.random.key(1), 0)[0]
    actions = np.asarray(trajectory.actions)
    assert not np.array_equal(actions[:, 0], actions[:, 2])  # worlds 0 and 2 have the same level
    assert not np.array_equal(actions, problem.play(problem.levels, jax.random.key(2), 0)[0].actions)
    assert len(np.unique(actions, axis=0)) > 1


def test_a_part_of_the_worlds_acts_as_it_does_in_the_whole(problem):
    whole = problem.play(problem.levels, jax.random.key(1), 0)[0]
    second_half = jax.tree.map(lambda x: x[2:], problem.levels)
    part = problem.play(second_half, jax.random.key(1), 2)[0]
    np.testing.assert_array_equal(part.actions, whole.actions[:, 2:])
    np.testing.assert_allclose(part.rewards, whole.rewards[:, 2:], atol=1e-5)


def test_inside_shard_map_the_trajectory_is_the_same(problem):
    def local(levels, key):
        prepared = problem.env.prepare(levels)
        size = levels.position.shape[0]
        numbers = jax.lax.axis_index(DATA_AXIS) * size + jnp.arange(size)
        start = Worlds(prepared, *problem.env.reset(prepared))
        return unroll(
            problem.policy, problem.params, problem.env, start._replace(numbers=numbers), key, STEPS
        ).trajectory

    on_mesh = jax.shard_map(
        local,
        mesh=data_mesh(jax.devices()[:1]),
        in_specs=(PartitionSpec(DATA_AXIS), PartitionSpec()),
        out_specs=PartitionSpec(None, DATA_AXIS),
        check_vma=False,
    )
    found = jax.jit(on_mesh)(problem.levels, jax.random.key(1))
    expected = problem.play(problem.levels, jax.random.key(1), 0)[0]
    np.testing.assert_array_equal(found.actions, expected.actions)
    np.testing.assert_allclose(found.rewards, expected.rewards, atol=1e-5)


@dataclasses.dataclass(frozen=True)
class _Ended:
    solved: jax.Array
    failed: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    unstable: jax.Array
    contact_overflow: jax.Array
    speed_limited: jax.Array
    missing_effects: jax.Array
    invalid_actions: jax.Array
    invalid_rewards: jax.Array
    invalid_controls: jax.Array
    invalid_scene: jax.Array


def test_outcomes_by_hand():
    counts = {name: jnp.asarray([number, 0, 0]) for number, name in enumerate(PHYSICS_FIELDS[1:], start=4)}
    info = _Ended(
        unstable=jnp.asarray([False, False, True]),
        **counts,
        solved=jnp.asarray([True, False, False]),
        failed=jnp.asarray([False, True, False]),
        episode_return=jnp.asarray([1.5, -1.0, 0.25]),
        episode_length=jnp.asarray([7, 3, 9]),
    )
    done = jnp.asarray([True, True, False])
    both = add_step(add_step(no_outcomes(3), done, info), done, info)
    assert both.num_finished.tolist() == [2, 2, 0]
    assert both.num_solved.tolist() == [2, 0, 0]
    assert both.first_solved.tolist() == [1, 0, 0]
    assert both.first_failed.tolist() == [0, 1, 0]
    assert both.first_return.tolist() == [1.5, -1.0, 0.25]
    assert both.return_sum.tolist() == [3.0, -2.0, 0.0]
    assert both.length_sum.tolist() == [14, 6, 0]
    assert both.physics.unstable.tolist() == [0, 0, 2]
    assert both.physics.missing_effects.tolist() == [2, 0, 0]  # steps, whatever the bits
    assert both.physics.speed_limited.tolist() == [2 * int(counts["speed_limited"][0]), 0, 0]
