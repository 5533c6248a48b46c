"""A process with 64-bit types on (`jax_enable_x64`): levels, worlds and policies stay what they are, float32."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend import core

from kinetix_dist import prng
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.generator_config import generator
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.sets import load_level_set, read_level
from kinetix_dist.models.policy import NETWORKS, PolicyConfig, make_policy
from tests.helpers import REPOSITORY

NETWORK_OF = {"entity": "transformer", "flat": "flat", "pixels": "cnn", "entity_kinetix": "transformer_kinetix"}


@pytest.fixture(scope="module")
def levels() -> Level:
    return load_level_set("designed_s")[0]


def made_in_64_bits(program: Any) -> Iterator[str]:
    """Operations of a traced program, and of those in it, that make float64 of anything but a Python number."""
    for equation in program.eqns:
        for result in equation.outvars:
            if getattr(result.aval, "dtype", None) == np.float64 and not result.aval.weak_type:
                yield str(equation)
        for inner in jax.tree.leaves(equation.params, is_leaf=lambda x: isinstance(x, core.Jaxpr | core.ClosedJaxpr)):
            if isinstance(inner, core.Jaxpr | core.ClosedJaxpr):
                yield from made_in_64_bits(getattr(inner, "jaxpr", inner))


def assert_float32(function: Callable[..., Any], *arguments: Any) -> Any:
    """The shapes that it gives."""
    traced = jax.jit(function).trace(*arguments)
    assert list(made_in_64_bits(traced.jaxpr.jaxpr)) == []
    assert not [x for x in jax.tree.leaves(traced.out_info) if x.dtype in (np.float64, np.int64)]
    return traced.out_info


def test_a_level_from_a_file_is_the_same(public_levels):
    own = REPOSITORY / "levels"
    files = [own / "s" / "aim_rocket.json", own / "m" / "lift.json", sorted((public_levels / "s").glob("*.json"))[0]]
    for file in files:
        expected, _ = read_level(file)
        with jax.enable_x64(True):
            level, _ = read_level(file)
        for one, other in zip(jax.tree.leaves(level), jax.tree.leaves(expected), strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", ["default", "kinetix", "tasks"])
def test_random_levels_are_float32(name):
    with jax.enable_x64(True):
        assert_float32(lambda key: generate_level(key, SIZES["s"], generator(name)), prng.key(0))


@pytest.mark.parametrize("observation", NETWORK_OF)
def test_worlds_and_policies_are_float32(observation, levels):
    env = Environment(EnvConfig(observation=observation))
    policy = make_policy(PolicyConfig(network=NETWORK_OF[observation]), env.action_distribution.head_sizes)
    with jax.enable_x64(True):
        prepared = assert_float32(env.prepare, levels)
        state, obs = assert_float32(env.reset, prepared)
        actions = env.action_space.sample(prng.key(0), 5)
        assert_float32(env.step, prepared, state, actions)
        seen = assert_float32(env.observe, prepared, obs)
        params = assert_float32(policy.init, prng.key(0), seen)
        outputs, _ = assert_float32(policy.apply, params, seen)
        uniforms = prng.uniform(prng.key(0), (5, env.action_distribution.num_uniforms))
        assert_float32(env.action_distribution.sample, outputs, uniforms)


@pytest.mark.parametrize("network", [name for name in NETWORKS if name not in NETWORK_OF.values()])
def test_other_networks_are_float32(network, levels):
    env = Environment(EnvConfig())
    policy = make_policy(PolicyConfig(network=network), env.action_distribution.head_sizes)
    with jax.enable_x64(True):
        seen = jax.tree.map(lambda x: jnp.zeros((2, *x.shape), x.dtype), env.observation_space)
        params = assert_float32(policy.init, prng.key(0), seen)
        assert_float32(policy.apply, params, seen)
