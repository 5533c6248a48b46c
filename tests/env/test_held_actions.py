"""Random held actions: what they solve is solved again by the same key, from the start and from states on the way."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.held_actions import episode_keys, solved_after, starting_from, states_on_the_way
from kinetix_dist.level.sets import load_level_set

EPISODES = 128


@pytest.fixture(scope="module")
def env():
    return Environment(EnvConfig(size="s", max_steps=160))


@pytest.fixture(scope="module")
def played(env):
    """Levels of the designed set, EPISODES of each: (levels [W], keys [W], after [W])."""
    designed, _ = load_level_set("designed_s", "s")
    number = np.repeat(np.arange(len(designed.angle)), EPISODES)
    levels = jax.tree.map(lambda x: np.asarray(x)[number], designed)
    keys = episode_keys(prng.key(3), jnp.asarray(number), jnp.asarray(np.arange(len(number)) % EPISODES))
    return levels, keys, np.asarray(jax.jit(solved_after, static_argnums=0)(env, levels, keys))


def test_some_levels_are_solved_and_not_at_once(played):
    *_, after = played
    assert 0.01 < (after > 0).mean() < 0.9 and after.max() > 10


def test_an_episode_depends_on_its_key_alone(env, played):
    levels, keys, after = played
    some = np.flatnonzero(after)[:5]
    again = jax.jit(solved_after, static_argnums=0)(env, jax.tree.map(lambda x: x[some], levels), keys[some])
    np.testing.assert_array_equal(again, after[some])


def test_states_on_the_way_are_those_of_the_episode(env, played):
    levels, keys, after = played
    some = np.flatnonzero(after > 8)[:6]
    levels, keys = jax.tree.map(lambda x: x[some], levels), keys[some]
    times = np.stack([np.zeros(6), after[some] // 2, np.full(6, 159)], axis=1).astype(np.int32)
    again, states = jax.jit(states_on_the_way, static_argnums=0)(env, levels, keys, times)
    np.testing.assert_array_equal(again, after[some])
    start = np.asarray(states[:, 0])
    is_there = np.asarray(levels.scene.shapes.active)
    np.testing.assert_allclose(start[is_there][:, :2], np.asarray(levels.position)[is_there], atol=1e-5)
    assert np.abs(np.asarray(states[:, 1])[is_there] - start[is_there]).max() > 0.1  # something moved
    assert not np.asarray(states[after[some] < 159, 2]).any()  # it was over by then
    begun = starting_from(levels, states[:, 1])
    moving = env.engine.bodies(env.prepare(begun).initial_packed_state)
    np.testing.assert_allclose(np.asarray(moving[0])[is_there], np.asarray(states[:, 1, :, :2])[is_there], atol=1e-5)


def test_a_level_begun_near_its_goal_is_solved_more_often(env, played):
    """By the same actions drawn anew: four steps before the goal most of them arrive."""
    levels, keys, after = played
    some = np.flatnonzero(after > 12)
    levels = jax.tree.map(lambda x: x[some], levels)
    times = (after[some] - 4)[:, None].astype(np.int32)
    _, states = jax.jit(states_on_the_way, static_argnums=0)(env, levels, keys[some], times)
    fresh = episode_keys(prng.key(4), jnp.arange(len(some)), jnp.zeros(len(some), jnp.int32))
    near = jax.jit(solved_after, static_argnums=0)(env, starting_from(levels, states[:, 0]), fresh)
    far = jax.jit(solved_after, static_argnums=0)(env, levels, fresh)
    assert (np.asarray(near) > 0).mean() > (np.asarray(far) > 0).mean() + 0.2
