"""Bound action heads: the engine's response when a head changes; effect of leaving the others out."""

from __future__ import annotations

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.config import ConfigError
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.recipes import recipe
from tests.helpers import present
from tests.level.random_levels import random_levels

NUM_LEVELS, STEPS = 96, 12


@pytest.fixture(scope="module")
def played():
    """(bound [W, 6], motion of all bodies by actions [T, W, 6])."""
    env = Environment(EnvConfig(size="s", max_steps=10_000))
    prepared = env.prepare(random_levels("s", NUM_LEVELS, seed=3))

    @jax.jit
    def motion(actions):
        def step(state, action):
            state, obs, _, done, _ = env.transition(prepared, state, action)
            return state, (obs.bodies, done)

        return jax.lax.scan(step, env.reset(prepared)[0], actions)[1]

    return np.asarray(prepared.bound_heads), motion


def _actions(seed):
    space = ACTION_SPACES["multi_discrete"]
    return jnp.stack([space.sample(jax.random.key(1000 * seed + step), NUM_LEVELS) for step in range(STEPS)])


def test_heads_that_are_not_bound_move_nothing(played):
    bound, motion = played
    first, second = _actions(1), _actions(2)
    bodies, _ = motion(first)
    others, _ = motion(jnp.where(bound, first, second))
    np.testing.assert_array_equal(bodies, others)
    assert 0.05 < bound.mean() < 0.7  # of both kinds there are some


def test_each_head_that_is_bound_moves_something(played):
    """Forward all the time against off. A motor may be held: joints at their limits, shapes that are wedged."""
    bound, motion = played
    off = jnp.zeros((STEPS, NUM_LEVELS, 6), jnp.int32)
    still, _ = motion(off)
    for head in range(6):
        moved, _ = motion(off.at[..., head].set(1))
        differs = (np.asarray(moved) != np.asarray(still)).any(axis=(0, 2, 3))
        assert not differs[~bound[:, head]].any()
        assert differs[bound[:, head]].mean() > 0.8


def test_leaving_out_unbound_heads_keeps_the_expected_gradient():
    """Enumerates all actions: gradient of E[A grad log p] where A depends on bound heads alone, and of the entropy."""
    distribution = present(ACTION_SPACES["multi_discrete"].distribution)
    bound = jnp.array([True, False, False, True, False, True])
    logits = tuple(jax.random.normal(jax.random.key(i), (size,)) for i, size in enumerate(distribution.head_sizes))
    actions = jnp.array(list(itertools.product(*(range(size) for size in distribution.head_sizes))))
    advantages = jax.random.normal(jax.random.key(9), (3, 3, 2))[actions[:, 0], actions[:, 3], actions[:, 5]]

    def many(logits):
        return tuple(jnp.broadcast_to(head, (len(actions), *head.shape)) for head in logits)

    probabilities = jnp.exp(distribution.log_prob_and_entropy(many(logits), actions)[0])
    np.testing.assert_allclose(probabilities.sum(), 1.0, rtol=1e-5)

    def objective(logits, **counted):
        log_prob, entropy = distribution.log_prob_and_entropy(many(logits), actions, **counted)
        return jnp.sum(probabilities * advantages * log_prob), entropy[0]

    of_all = jax.grad(lambda x: objective(x)[0])(logits)
    of_bound = jax.grad(lambda x: objective(x, bound=bound)[0])(logits)
    of_entropy = jax.grad(lambda x: objective(x, bound=bound)[1])(logits)
    for head, is_bound in enumerate(bound):
        if is_bound:
            np.testing.assert_allclose(of_bound[head], of_all[head], atol=1e-5)
        else:
            np.testing.assert_allclose(of_all[head], 0.0, atol=1e-5)  # zero in expectation, by chance alone
            np.testing.assert_array_equal(of_bound[head], 0.0)
            np.testing.assert_array_equal(of_entropy[head], 0.0)


@pytest.mark.parametrize("name", ["multi_discrete", "continuous"])
def test_samples_and_log_probabilities_leave_out_the_same(name):
    distribution = present(ACTION_SPACES[name].distribution)
    outputs = tuple(jax.random.normal(jax.random.key(i), (5, size)) for i, size in enumerate(distribution.head_sizes))
    uniforms = jax.random.uniform(jax.random.key(7), (5, distribution.num_uniforms))
    bound = jax.random.bernoulli(jax.random.key(8), 0.5, (5, 6))
    actions, log_prob = distribution.sample(outputs, uniforms, bound=bound)
    np.testing.assert_array_equal(actions, distribution.sample(outputs, uniforms)[0])  # sampling is not changed
    again, _ = distribution.log_prob_and_entropy(outputs, actions, bound=bound)
    np.testing.assert_allclose(again, log_prob, rtol=1e-5)
    none, entropy = distribution.log_prob_and_entropy(outputs, actions, bound=jnp.zeros((5, 6), bool))
    np.testing.assert_array_equal(none, 0.0)
    np.testing.assert_array_equal(entropy, 0.0)


def test_a_space_of_one_head_cannot_be_masked():
    config = recipe("tiny")
    ppo = dataclasses.replace(config.ppo, mask_unbound_heads=True)
    env = dataclasses.replace(config.env, action_space="discrete")
    with pytest.raises(ConfigError, match="mask_unbound_heads"):
        dataclasses.replace(config, ppo=ppo, env=env)


@pytest.mark.parametrize("space", ["discrete", "continuous"])
def test_a_space_without_an_output_a_colour_cannot_be_read_by_colour(space):
    config = recipe("tiny")
    policy = dataclasses.replace(config.policy, read_out="colour")
    ppo = dataclasses.replace(config.ppo, mask_unbound_heads=False)
    env = dataclasses.replace(config.env, action_space=space)
    with pytest.raises(ValueError, match=r"not one a colour \(4 of motors, 2 of thrusters\).*'multi_discrete'"):
        dataclasses.replace(config, policy=policy, env=env, ppo=ppo)
