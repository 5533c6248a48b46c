"""Networks on real levels: slots have no meaning, one set of weights plays all sizes, every action space has heads."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jax2d.scene import Array, capacity_of, stack_worlds
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.env.observations import OBSERVATIONS, Moving
from kinetix_dist.level.fit import fit_level
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.schema import load_level
from kinetix_dist.models.gru import act, initial_memory
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy
from tests.helpers import REPOSITORY
from tests.models.synthetic import random_obs
from tests.slots import shuffled_slots, take_slots

NUM_LEVELS = 8  # of each size
HEAD_SIZES = (3, 3, 3, 3, 2, 2)
SMALL = {"encoder_size": 16, "attention_features": 8, "num_layers": 2, "hidden_size": 16, "hidden_layers": 2}
POLICIES = {
    "entity": PolicyConfig(**SMALL, recurrent="gru", memory_size=8),
    "entity_kinetix": PolicyConfig(network="transformer_kinetix", **SMALL),
}


def levels_of(size: str) -> list[Level]:
    files = sorted((REPOSITORY / "levels" / size).glob("*.json"))
    return [load_level(file, size)[0] for file in files if "proof" not in file.name][:NUM_LEVELS]


def start(observation: str, levels: Level) -> object:
    """Policy input of the first states."""
    part = OBSERVATIONS[observation]
    names = ("position", "angle", "velocity", "angular_velocity")
    num_worlds, num_shapes = levels.angle.shape
    moving = Moving(
        **{name: getattr(levels, name) for name in names},
        touching=jnp.zeros((num_worlds, num_shapes, 1), jnp.uint32),
        has_stepped=jnp.zeros(num_worlds, bool),
    )
    return part.join(part.static(levels), part.dynamic(moving))


@functools.cache
def outputs_of_levels(observation: str, size: str) -> tuple[np.ndarray, ...]:
    """Outputs for S levels in arrays of a size, levels of that size, and these with shuffled slots: [8, 17].

    By one set of weights, drawn for size S and moved at random.
    """
    rng = np.random.default_rng(0)
    policy = make_policy(POLICIES[observation], HEAD_SIZES)
    shapes = jax.eval_shape(functools.partial(start, observation), stack_worlds(levels_of("s")[:1]))
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    params = init_params(policy, zeros, jax.random.key(0))
    params = jax.tree.map(lambda x: x + 0.1 * rng.standard_normal(x.shape).astype(np.float32), params)
    smallest = [fit_level(level, SIZES[size]) for level in levels_of("s")]
    own = levels_of(size)
    shuffled = [take_slots(level, shuffled_slots(capacity_of(level.scene), rng)) for level in own]

    @jax.jit
    def play(levels: Level) -> Array:
        obs = start(observation, levels)
        memory = initial_memory(policy, len(levels.angle))
        memory = None if memory is None else memory + 0.5  # as if there had been steps before
        logits, value, _ = act(policy, params, obs, memory)
        return jnp.concatenate([*logits, value[:, None]], axis=1)

    return tuple(np.split(np.asarray(play(stack_worlds(smallest + own + shuffled))), 3))


@pytest.mark.parametrize("observation", POLICIES)
@pytest.mark.parametrize("size", ["s", *(pytest.param(size, marks=pytest.mark.long) for size in ("m", "l"))])
def test_the_order_of_slots_does_not_matter(observation: str, size: str) -> None:
    """Compared at a start: the touches that the public package sees one way depend on slots."""
    _, own, shuffled = outputs_of_levels(observation, size)
    assert own.std(axis=0).min() > 1e-3  # levels do
    np.testing.assert_allclose(shuffled, own, atol=1e-5)  # order of float32 sums


@pytest.mark.parametrize("observation", POLICIES)
def test_one_set_of_weights_plays_all_sizes_and_sees_the_same_level_alike(observation: str) -> None:
    in_s, in_m, in_l = (outputs_of_levels(observation, size)[0] for size in "sml")
    np.testing.assert_allclose(in_m, in_s, atol=1e-5)  # order of float32 sums
    np.testing.assert_allclose(in_l, in_s, atol=1e-5)


TRAINABLE = [name for name in ACTION_SPACES if ACTION_SPACES[name].distribution is not None]


@pytest.mark.long
@pytest.mark.parametrize("name", TRAINABLE)
def test_a_network_has_the_outputs_of_the_action_space(name: str) -> None:
    """All heads at once: sizes, and actions drawn from them that the space takes."""
    space = ACTION_SPACES[name]
    distribution = space.distribution
    assert distribution is not None
    obs = random_obs(5, SIZES["s"])
    policy = make_policy(PolicyConfig(**SMALL), distribution.head_sizes)
    outputs, value = jax.jit(policy.apply)(init_params(policy, obs, jax.random.key(0)), obs)
    assert [head.shape for head in outputs] == [(5, size) for size in distribution.head_sizes]
    assert value.shape == (5,)
    uniforms = jax.random.uniform(jax.random.key(1), (5, distribution.num_uniforms))
    actions, log_prob = distribution.sample(outputs, uniforms)
    space.check(actions, num_worlds=5)
    again, entropy = distribution.log_prob_and_entropy(outputs, actions)
    np.testing.assert_allclose(log_prob, again, atol=1e-5)
    assert np.isfinite(entropy).all()
