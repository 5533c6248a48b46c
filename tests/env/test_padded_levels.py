"""A level in larger arrays is the same world: it moves the same, and a policy sees and answers the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.fit import pad_levels
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy

NUM_STEPS = 60  # environment steps: 2 s, in which shapes fall, meet and are driven
ATOL = 1e-5  # of logits and values near 1: float32 sums over more tokens, of which those that are empty count nothing
POLICY = PolicyConfig(encoder_size=16, attention_features=8, num_layers=1, hidden_size=16, hidden_layers=1)


def played(size):
    """Course of the designed S levels in arrays of a size: active shapes' paths, rewards, ends, logits and values."""
    env = Environment(EnvConfig(size=size))
    levels = pad_levels(jax.tree.map(jnp.asarray, load_level_set("designed_s", "s")[0]), SIZES[size])
    policy = make_policy(POLICY, env.action_distribution.head_sizes)
    prepared = env.prepare(levels)
    zeros = jax.tree.map(jnp.zeros_like, env.observe(prepared, prepared.initial_obs))
    rng = np.random.default_rng(0)
    params = init_params(policy, zeros, jax.random.key(0))  # outputs near 0, so moved
    params = jax.tree.map(lambda x: x + 0.1 * rng.standard_normal(x.shape).astype(np.float32), params)
    actions = jax.random.randint(jax.random.key(1), (NUM_STEPS, levels.position.shape[0], 6), 0, 2)

    @jax.jit
    def play(prepared, actions):
        def step(carry, action):
            state, obs = carry
            outputs, values = policy.apply(params, env.observe(prepared, obs))
            state, obs, reward, done, _ = env.step(prepared, state, action)
            bodies = env.engine.bodies(state.packed_state)
            return (state, obs), (bodies, reward, done, outputs, values)

        return jax.lax.scan(step, env.reset(prepared), actions)[1]

    bodies, *answers = jax.device_get(play(prepared, actions))
    circles = SIZES[size].polygons + np.arange(SIZES["s"].circles)
    shapes = np.concatenate([np.arange(SIZES["s"].polygons), circles])  # those of the small arrays
    is_active = np.asarray(levels.scene.shapes.active)[:, shapes]
    bodies = [np.where(is_active[None, ..., *[None] * (part.ndim - 3)], part[:, :, shapes], 0.0) for part in bodies]
    return bodies, *answers


@pytest.mark.long
def test_a_small_level_in_larger_arrays_moves_and_is_seen_as_it_is():
    (bodies, reward, done, outputs, values), large = played("s"), played("l")
    assert np.abs(bodies[0][-1] - bodies[0][0]).max() > 0.5  # m: something happens
    for ours, theirs in zip((*bodies, reward, done), (*large[0], *large[1:3]), strict=True):
        np.testing.assert_array_equal(ours, theirs)  # to the bit: empty slots are nothing to the engine
    assert max(np.abs(head).max() for head in outputs) > 0.1
    for ours, theirs in zip((*outputs, values), (*large[3], large[4]), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=ATOL)
