"""The random-rollout example of the public package (README of kinetix-env 3.0.2), with its imports changed."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.palette import ROLE_PALETTE
from kinetix_dist import prng
from kinetix_dist.env.wrappers.kinetix import (
    ActionType,
    EnvParams,
    ObservationType,
    StaticEnvParams,
    make_kinetix_env,
    make_render_pixels,
    make_reset_fn_sample_kinetix_level,
)
from kinetix_dist.level.level import Level

SMALL = StaticEnvParams(num_polygons=5, num_circles=2, num_joints=1, num_thrusters=1)


def test_without_the_dense_term_the_reward_is_the_sparse_one():
    for scale, reward in ((0.2, "dense"), (0.0, "sparse")):
        params = EnvParams(dense_reward_scale=scale)
        env = make_kinetix_env(ActionType.CONTINUOUS, ObservationType.SYMBOLIC_FLAT, None, params, SMALL)
        assert env.env.config.reward == reward and env.default_params == params


@pytest.mark.long
@pytest.mark.parametrize("static_env_params", [SMALL, pytest.param(StaticEnvParams(), marks=pytest.mark.slow)])
def test_the_example_of_the_public_package_runs(static_env_params):
    # Use default parameters
    env_params = EnvParams()

    # Create the environment
    env = make_kinetix_env(
        observation_type=ObservationType.PIXELS,
        action_type=ActionType.CONTINUOUS,
        reset_fn=make_reset_fn_sample_kinetix_level(env_params, static_env_params),
        env_params=env_params,
        static_env_params=static_env_params,
    )

    # Reset the environment state (this resets to a random level)
    _rngs = jax.random.split(jax.random.PRNGKey(0), 3)

    obs, env_state = env.reset(_rngs[0], env_params)

    # Take a step in the environment
    action = env.action_space(env_params).sample(_rngs[1])
    obs, env_state, reward, done, info = env.step(_rngs[2], env_state, action, env_params)

    # Render environment
    renderer = make_render_pixels(env_params, env.static_env_params)

    pixels = renderer(env_state)

    upright = np.asarray(pixels.astype(jnp.uint8).transpose(1, 0, 2)[::-1])

    # What the example shows agrees with what the policy sees, and has the goal in it.
    assert obs.shape == (125, 125, 3) and obs.dtype == jnp.uint8 and env.observation_space(env_params).contains(obs)
    seen = upright.reshape(125, 4, 125, 4, 3).mean((1, 3))
    assert np.abs(seen - obs).mean() < 0.3  # actions have their colours in what a policy sees
    blue = np.array(ROLE_PALETTE[2])
    assert (np.abs(upright - blue).max(-1) < 2).any() or (np.abs(upright - blue * 0.62).max(-1) < 2).any()
    assert reward.shape == done.shape == () and not done and info["episode_length"] == 1


def no_level(key: jax.Array) -> Level:
    raise AssertionError("a level is drawn")


def test_what_is_no_size_and_other_parameters_are_refused():
    with pytest.raises(ValueError, match=r"has \(7, 4, 6, 2\).*s \(5, 2, 1, 1\)"):
        make_kinetix_env(
            ActionType.DISCRETE, ObservationType.SYMBOLIC_FLAT, no_level, None, StaticEnvParams(num_polygons=7)
        )
    env = make_kinetix_env(ActionType.DISCRETE, ObservationType.SYMBOLIC_FLAT, no_level, None, SMALL)
    with pytest.raises(ValueError, match=r"made for EnvParams.*max_timesteps=256"):
        env.step(jax.random.key(0), None, 0, EnvParams(max_timesteps=3))


@pytest.mark.long
def test_an_episode_starts_from_the_level_or_state_that_a_call_gives():
    params = EnvParams(max_timesteps=2)
    draw = make_reset_fn_sample_kinetix_level(params, SMALL)
    level, other = draw(prng.key(1)), draw(prng.key(2))
    # As the public package: no function, so that each call says where its episode starts.
    env = make_kinetix_env(ActionType.DISCRETE, ObservationType.SYMBOLIC_FLAT, None, params, SMALL)
    nothing = 8
    first_obs, first = env.reset(prng.key(0), env_params=params, override_reset_state=level)
    np.testing.assert_array_equal(first.source.position, level.position)
    obs, second, _, done, _ = env.step(prng.key(0), first, nothing, params, other)
    assert not done and second.time == 1 and not np.array_equal(obs, first_obs)
    # The episode ends in its second step, and the next one starts from the level of this call.
    obs, state, _, done, info = env.step(prng.key(0), second, nothing, params, override_reset_state=other)
    assert done and state.time == 0
    np.testing.assert_array_equal(state.source.position, other.position)
    np.testing.assert_array_equal(obs, env.reset(prng.key(5), params, other)[0])
    # A state goes on where it is, with its clock.
    obs, again = env.reset(prng.key(0), params, second)
    assert again.time == 1
    *_, done, goes_on = env.step(prng.key(3), again, nothing, params, level)
    assert done
    np.testing.assert_allclose(goes_on["final_observation"], info["final_observation"], atol=1e-6)
    with pytest.raises(ValueError, match="no reset_fn; give a level or a state as override_reset_state"):
        env.reset(prng.key(0), params)


def test_without_auto_reset_an_episode_that_ended_stays_where_it_is():
    params = EnvParams(max_timesteps=1)
    level = make_reset_fn_sample_kinetix_level(params, SMALL)(prng.key(1))
    env = make_kinetix_env(ActionType.DISCRETE, ObservationType.SYMBOLIC_FLAT, None, params, SMALL, auto_reset=False)
    _, state = env.reset(prng.key(0), params, level)
    obs, state, _, done, info = env.step(prng.key(0), state, 8, params)
    assert done and state.time == 1
    np.testing.assert_array_equal(obs, info["final_observation"])
