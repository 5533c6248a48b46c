"""`kinetix_dist.load_policy`: a pure function that works under `jit`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import kinetix_dist as kd
from kinetix_dist import prng
from kinetix_dist.evaluation.policies import NetworkPolicy
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy

NUM_ENVS = 4


@pytest.fixture(scope="module")
def policy() -> kd.PolicyFunction:
    return kd.load_policy("generalist")


@pytest.fixture(scope="module")
def env() -> kd.BatchedEnv:
    return kd.make("s", num_envs=NUM_ENVS, levels="designed_s")


def test_a_policy_works_under_jit_closed_over_or_as_an_argument(policy: kd.PolicyFunction, env: kd.BatchedEnv) -> None:
    observation, _ = env.reset(prng.key(0))
    assert all(isinstance(x, jax.Array) for x in jax.tree.leaves(policy.params))
    closed_over, memory = jax.jit(lambda observation, key: policy(observation, key))(observation, prng.key(1))
    given, _ = jax.jit(lambda policy, observation, key: policy(observation, key))(policy, observation, prng.key(1))
    assert memory is None
    np.testing.assert_array_equal(closed_over, given)
    env.action_space.check(given, NUM_ENVS)


def test_it_plays_in_one_scan(policy: kd.PolicyFunction, env: kd.BatchedEnv) -> None:
    @jax.jit
    def play(key: jax.Array) -> jax.Array:
        def step(carry: tuple, key: jax.Array) -> tuple[tuple, jax.Array]:
            observation, state = carry
            action, _ = policy(observation, key)
            observation, state, _, _, info = env.step(key, state, action)
            return (observation, state), info.solved

        return jax.lax.scan(step, env.reset(key), jax.random.split(key, 64))[1].sum()

    assert play(jax.random.key(0)) > 0


def test_it_does_without_typed_keys(policy: kd.PolicyFunction, env: kd.BatchedEnv) -> None:
    key = jax.random.PRNGKey(0)
    observation, _ = env.reset(key)
    np.testing.assert_array_equal(policy(observation, key)[0], policy(observation, jax.random.key(0))[0])


def test_another_kind_of_observation_is_refused(policy: kd.PolicyFunction) -> None:
    with pytest.raises(ValueError, match=r"takes 'entity' observations.*EnvConfig\(observation='entity'\)"):
        policy(jnp.zeros((2, 100)), prng.key(0))


def test_a_recurrent_policy_gives_its_memory(env: kd.BatchedEnv) -> None:
    observation, _ = env.reset(prng.key(0))
    environment = env.environment
    network = make_policy(
        PolicyConfig(recurrent="gru", memory_size=8, encoder_size=16, hidden_size=16, hidden_layers=1),
        environment.action_distribution.head_sizes,
    )
    policy = kd.PolicyFunction(
        params=init_params(network, observation, prng.key(0)),
        network_policy=NetworkPolicy(network, environment.action_distribution),
        env_config=env.config,
        observation_structure=jax.tree.structure(observation),
    )
    _, memory = policy(observation, prng.key(1))
    assert memory is not None and memory.shape == (NUM_ENVS, 8)
    _, later = policy(observation, prng.key(1), memory)
    assert later is not None and not np.array_equal(memory, later)
    done = jnp.array([True, False, False, False])
    reset = policy.reset_memory(later, done)
    assert reset is not None and not reset[0].any() and np.array_equal(reset[1:], later[1:])


def test_a_run_or_a_checkpoint_is_loaded_by_its_path(policy: kd.PolicyFunction, tmp_path: Path) -> None:
    from tests.helpers import REPOSITORY

    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "00000104").symlink_to(REPOSITORY / "pretrained" / "generalist")
    of_run = kd.load_policy(tmp_path, greedy=True)
    assert dataclasses.replace(policy.network_policy, greedy=True) == of_run.network_policy
    with pytest.raises(Exception, match="nowhere"):
        kd.load_policy("nowhere")
