"""The environment behind the interfaces of gymnasium and gymnax, held to what those packages check themselves."""

from __future__ import annotations

import importlib
import sys

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import ClipReward, DictInfoToList, RecordEpisodeStatistics
from gymnax.experimental.rollout import RolloutWrapper

from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.wrappers.gymnasium_env import KinetixEnv, KinetixVectorEnv
from kinetix_dist.env.wrappers.gymnax_env import GymnaxEnv
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set
from tests.helpers import present

SPACES = ["multi_discrete", "continuous", "discrete"]
MAX_STEPS = 8


@pytest.fixture(scope="module")
def levels() -> Level:
    return load_level_set("designed_s")[0]


def config(observation: str = "flat", space: str = "multi_discrete") -> EnvConfig:
    return EnvConfig(observation=observation, action_space=space, max_steps=MAX_STEPS)


@pytest.mark.parametrize(
    ("observation", "space"),
    [("flat", "multi_discrete"), ("entity", "continuous"), pytest.param("pixels", "discrete", marks=pytest.mark.slow)],
)
def test_gymnasium_accepts_the_environment_of_one_world(observation, space, levels):
    env = KinetixEnv(config(observation, space), levels, render_mode="rgb_array")
    check_env(env, skip_render_check=True)  # that one looks for env.spec, which environments not made by name lack
    assert present(env.render()).dtype == np.uint8


@pytest.fixture(scope="module")
def envs(levels) -> KinetixVectorEnv:
    return KinetixVectorEnv(config(), levels, num_envs=5, render_mode="rgb_array")


def test_a_vector_keeps_to_its_spaces_and_gives_what_the_environment_gives(envs, levels):
    obs, infos = envs.reset(seed=3, options={"levels": [0, 1, 2, 3, 4]})
    assert infos == {} and envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    env = Environment(config())
    prepared = env.prepare(jax.tree.map(lambda x: x[:5], levels))
    state, expected = env.reset(prepared)
    envs.action_space.seed(0)
    for _ in range(2 * MAX_STEPS + 1):
        assert obs in envs.observation_space and obs[0] in envs.single_observation_space
        np.testing.assert_allclose(obs, env.observe(prepared, expected), atol=1e-6)  # compiled apart
        actions = envs.action_space.sample()
        chosen = jnp.asarray(actions, jnp.int32)
        _, end, *_ = env.transition(prepared, state, chosen)
        end = env.observe(prepared, end)
        obs, rewards, terminations, truncations, infos = envs.step(actions)
        state, expected, reward, done, info = env.step(prepared, state, chosen)
        np.testing.assert_allclose(rewards, reward, atol=1e-6)
        np.testing.assert_array_equal(terminations | truncations, done)
        np.testing.assert_array_equal(truncations, info.timed_out)
        for world in np.flatnonzero(done):
            assert infos["_final_obs"][world] and infos["final_obs"][world] in envs.single_observation_space
            assert infos["final_info"]["episode_length"][world] == info.episode_length[world]
            assert not np.array_equal(infos["final_obs"][world], obs[world])  # one is the end, one the next start
            np.testing.assert_allclose(infos["final_obs"][world], end[world], atol=1e-6)
        if not done.any():
            assert infos == {}
    assert [picture.shape for picture in envs.render()] == [(524, 524, 3)] * 5


def test_gymnasiums_own_vector_wrappers_take_it(envs):
    wrapped = DictInfoToList(RecordEpisodeStatistics(envs))
    obs, _ = wrapped.reset(seed=1)
    again, _ = wrapped.reset(seed=1)
    np.testing.assert_array_equal(obs, again)
    for _ in range(MAX_STEPS - 1):
        wrapped.step(wrapped.action_space.sample())
    _, _, terminations, truncations, infos = wrapped.step(wrapped.action_space.sample())
    assert (terminations | truncations).any() and any("final_obs" in info for info in infos)
    assert any("episode" in info for info in infos)


def test_a_vector_without_autoreset_starts_the_worlds_of_the_mask_and_no_others(levels):
    ours = KinetixVectorEnv(config(), levels, num_envs=3, autoreset=False)
    theirs = SyncVectorEnv([lambda: KinetixEnv(config(), levels)] * 3, autoreset_mode=AutoresetMode.DISABLED)
    ours.reset(options={"levels": [1, 1, 1]})
    theirs.reset(options={"level": 1})
    num_resets = 0
    for step in range(2 * MAX_STEPS):
        actions = np.full((3, 6), step % 2)
        obs, rewards, terminations, truncations, _ = ours.step(actions)
        expected = theirs.step(actions)
        np.testing.assert_allclose(obs, expected[0], atol=1e-6)  # compiled apart
        np.testing.assert_allclose(rewards, expected[1], atol=1e-6)
        np.testing.assert_array_equal((terminations, truncations), expected[2:4])
        mask = terminations | truncations
        if step == 2:
            mask = np.array([False, True, False])  # from now on it is behind the others
        if mask.any():
            num_resets += 1
            begun, _ = ours.reset(options={"reset_mask": mask, "levels": [4, 1, 2]})
            np.testing.assert_array_equal(begun[~mask], obs[~mask])
            started = [
                theirs.reset(options={"reset_mask": np.arange(3) == world, "level": int(ours.level_numbers[world])})
                for world in np.flatnonzero(mask)
            ]
            np.testing.assert_allclose(begun, started[-1][0], atol=1e-6)
    assert num_resets == 4 and ours.level_numbers.tolist() == [4, 1, 2]


def test_a_world_that_ended_waits_for_its_reset(levels):
    envs = KinetixVectorEnv(config(), levels, num_envs=2, autoreset=False)
    with pytest.raises(gymnasium.error.ResetNeeded, match="for all worlds before"):
        envs.reset(options={"reset_mask": np.array([True, False])})
    envs.reset(seed=0)
    before = envs.level_numbers.copy()
    for _ in range(MAX_STEPS):
        *_, terminations, truncations, _ = envs.step(np.zeros((2, 6), int))
        if (terminations | truncations).any():
            break
    ended = terminations | truncations
    with pytest.raises(gymnasium.error.ResetNeeded, match=rf"worlds \{np.flatnonzero(ended).tolist()} have ended"):
        envs.step(np.zeros((2, 6), int))
    for bad in (np.array([True]), np.zeros(2, bool), np.array([0, 1])):
        with pytest.raises(ValueError, match="give 2 booleans, True in one world or more"):
            envs.reset(options={"reset_mask": bad})
    envs.reset(options={"reset_mask": ended})
    assert (envs.level_numbers == before)[~ended].all()
    envs.step(np.zeros((2, 6), int))


@pytest.mark.parametrize("autoreset", [True, False])
def test_what_a_vector_gives_is_the_callers_to_write(autoreset, levels):
    envs = KinetixVectorEnv(config(), levels, num_envs=2, autoreset=autoreset)
    wrapped = ClipReward(envs, -0.5, 0.5)
    obs, _ = wrapped.reset(seed=0)
    obs *= 0.5
    for _ in range(MAX_STEPS):
        obs, *arrays, infos = wrapped.step(np.zeros((2, 6), int))
        for array in (obs, *arrays, *(x for x in infos.values() if not autoreset)):
            array[:] = 0
        if infos:
            break
    kept, _ = envs.reset(options={"reset_mask": np.array([True, False])})
    assert infos and kept[1].any()  # what the caller wrote is not what the world is


def test_bad_calls_of_a_vector_are_refused(levels, envs):
    fresh = KinetixVectorEnv(config(), levels, num_envs=1)
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset"):
        fresh.step(fresh.action_space.sample())
    with pytest.raises(ValueError, match="give 5 numbers from 0 to"):
        envs.reset(options={"levels": [0, 1, 2, 3, 99]})
    envs.reset()
    with pytest.raises(ValueError, match="action 3 at"):
        envs.step(np.full((5, 6), 3))
    with pytest.raises(ValueError, match="actions have type float64; multi_discrete actions are integers"):
        envs.step(np.full((5, 6), 0.9))
    with pytest.raises(ValueError, match="give 5 numbers from 0 to"):
        envs.reset(options={"levels": [0.5, 1, 2, 3, 3]})
    with pytest.raises(ValueError, match="render_mode is 'human'"):
        KinetixEnv(config(), levels, render_mode="human")


@pytest.mark.parametrize(
    ("observation", "space"),
    [("entity", "multi_discrete"), pytest.param("flat", "continuous", marks=pytest.mark.slow)],
)
def test_gymnax_rolls_the_environment_out(observation, space, levels):
    env = GymnaxEnv(config(observation, space), levels)
    params = env.default_params
    assert params.max_steps_in_episode == MAX_STEPS
    rollout = RolloutWrapper(env=env, num_env_steps=2 * MAX_STEPS)
    keys = jax.random.split(jax.random.key(0), 4)
    obs, action, reward, next_obs, done, _ = rollout.batch_rollout(keys, None)
    assert reward.shape == done.shape == (4, 2 * MAX_STEPS) and action.shape[:2] == (4, 2 * MAX_STEPS)
    assert np.asarray(done)[:, :MAX_STEPS].any(axis=1).all()
    for tree in (obs, next_obs):
        one = jax.tree.map(lambda x: x[1, 3], tree)
        assert env.observation_space(params).contains(one)
    assert all(env.action_space(params).contains(one) for one in action.reshape(-1, 6))


def test_a_gymnax_episode_is_that_of_the_environment(levels):
    env = GymnaxEnv(config(), levels)
    params = env.default_params
    batch = Environment(config())
    obs, state = env.reset(jax.random.key(5), params)
    with pytest.raises(ValueError, match="actions have type float32; multi_discrete actions are integers"):
        env.step(jax.random.key(0), state, jnp.full(6, 0.9), params)
    prepared = state.level
    expected_state, expected = batch.reset(prepared)
    np.testing.assert_allclose(obs, batch.observe(prepared, expected)[0], atol=1e-6)
    for step in range(MAX_STEPS):
        key = jax.random.key(step)
        action = env.action_space(params).sample(key)
        obs, state, reward, terminated, truncated, info = env.step(key, state, action, params)
        expected_state, _, expected, done, _ = batch.step(prepared, expected_state, action[None])
        np.testing.assert_allclose(reward, expected[0], atol=1e-6)
        assert bool(terminated | truncated) == bool(done[0])
        if done[0]:
            assert int(state.time) == 0 and info["final_observation"].shape == obs.shape
            break
    assert bool(terminated | truncated)


def test_what_is_not_installed_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnax", None)
    monkeypatch.delitem(sys.modules, "kinetix_dist.env.wrappers")
    with pytest.raises(ImportError, match=r"gymnax is not installed.*pip install 'kinetix-dist\[wrappers\]'"):
        importlib.import_module("kinetix_dist.env.wrappers")
