"""`kinetix_dist.make`: many worlds as pure functions, and the same behind gymnasium's names."""

from __future__ import annotations

import os
import subprocess
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import kinetix_dist as kd
from kinetix_dist import gymnasium_envs, prng
from kinetix_dist.env.environment import Environment
from tests.helpers import PATIENCE_S, python_path

MAX_STEPS = 3
NUM_ENVS = 40  # more than restart at once


@pytest.fixture(scope="module")
def env() -> kd.BatchedEnv:
    config = kd.EnvConfig(size="s", observation="flat", max_steps=MAX_STEPS)
    return kd.make(config, num_envs=NUM_ENVS, levels="designed_s")


def test_importing_the_package_imports_no_jax() -> None:
    code = "import sys, kinetix_dist; print([name for name in ('jax', 'numpy', 'gymnasium') if name in sys.modules])"
    environment = os.environ | {"PYTHONPATH": python_path()}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment, timeout=PATIENCE_S
    )
    assert done.stdout.strip() == "[]"


def test_every_public_name_is_there_and_no_other() -> None:
    assert all(getattr(kd, name) is not None for name in kd.__all__)
    assert set(kd.__all__) <= set(dir(kd))
    with pytest.raises(AttributeError, match="no attribute 'mkae'"):
        kd.mkae  # noqa: B018


def test_steps_are_those_of_the_environment_until_an_episode_ends(env: kd.BatchedEnv) -> None:
    observation, state = env.reset(prng.key(0))
    other = Environment(env.config)
    prepared = other.prepare(jax.tree.map(lambda x: x[np.asarray(state.level_number)], env.levels))
    other_state, other_obs = other.reset(prepared)
    np.testing.assert_array_equal(observation, other.observe(prepared, other_obs))
    for step in range(MAX_STEPS - 1):
        action = env.action_space.sample(prng.key(step), NUM_ENVS)
        observation, state, reward, done, info = env.step(prng.key(step), state, action)
        other_state, other_obs, other_reward, other_done, _ = other.step(prepared, other_state, action)
        goes_on = ~np.asarray(done)
        np.testing.assert_array_equal(done, other_done)
        np.testing.assert_array_equal(reward, other_reward)
        np.testing.assert_array_equal(observation[goes_on], other.observe(prepared, other_obs)[goes_on])
    assert observation.shape[1:] == env.observation_space.shape and info.episode_length.max() == MAX_STEPS - 1


def test_worlds_that_end_together_all_start_another_level(env: kd.BatchedEnv) -> None:
    observation, state = env.reset(prng.key(1))
    first_levels = state.level_number
    for step in range(MAX_STEPS - 1):
        observation, state, *_ = env.step(prng.key(step), state, env.action_space.noop_actions(NUM_ENVS))
    observation, state, _, done, info = env.step(
        prng.key(MAX_STEPS - 1), state, env.action_space.noop_actions(NUM_ENVS)
    )
    assert done.mean() > 0.9 and info.timed_out.mean() > 0.9
    assert (state.level_number != first_levels).mean() > 0.5
    np.testing.assert_array_equal(state.episode.num_steps[done], 0)
    other = Environment(env.config)
    prepared = other.prepare(jax.tree.map(lambda x: x[np.asarray(state.level_number)], env.levels))
    np.testing.assert_array_equal(observation[done], other.observe(prepared, other.reset(prepared)[1])[done])
    np.testing.assert_array_equal(state.levels.motor_colour, prepared.motor_colour)
    jax.tree.map(np.testing.assert_array_equal, state.levels.packed_scene, prepared.packed_scene)


def test_a_state_is_drawn_in_one_call(env: kd.BatchedEnv) -> None:
    _, state = env.reset(prng.key(0))
    image = kd.draw(env, state, world=3, pixels_per_metre=30.0)
    assert image.dtype == np.uint8 and image.shape[2] == 3 and len(np.unique(image)) > 5
    with pytest.raises(ValueError, match="world is 40; there are worlds 0 to 39"):
        kd.draw(env, state, world=NUM_ENVS)


def test_random_levels_are_drawn_from_the_seed() -> None:
    config = kd.EnvConfig(size="s", observation="flat")
    first, again, other = (kd.make(config, num_levels=3, seed=seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first.levels.position, again.levels.position)
    assert not np.array_equal(first.levels.position, other.levels.position)
    assert first.level_names == ["random_0", "random_1", "random_2"]


def test_bad_arguments_are_refused(env: kd.BatchedEnv) -> None:
    with pytest.raises(ValueError, match="num_envs is 0"):
        kd.make("s", num_envs=0, levels="designed_s")
    with pytest.raises(ValueError, match="num_levels is 0"):
        kd.make("s", num_levels=0)
    _, state = env.reset(prng.key(0))
    with pytest.raises(ValueError, match=r"have shape \(2, 6\)"):
        env.step(prng.key(0), state, jnp.zeros((2, 6), jnp.int32))


def test_gymnasium_makes_environments_by_name() -> None:
    assert gymnasium_envs.IDS["m"] == "kinetix-dist/M-v0"
    envs = gymnasium.make_vec("kinetix-dist/S-v0", num_envs=3, levels="designed_s", observation="flat")
    observations, _ = envs.reset(seed=0)
    assert observations in envs.observation_space
    observations, rewards, *_ = envs.step(envs.action_space.sample())
    assert observations in envs.observation_space and rewards.shape == (3,)
    env = gymnasium.make("kinetix-dist/S-v0", levels="designed_s", observation="flat")
    check_env(env.unwrapped, skip_render_check=True)
