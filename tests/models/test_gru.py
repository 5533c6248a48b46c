"""Policies with memory: the formula, what is acted and what is learned, episodes, and a learner's minibatches."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from jax2d.scene import stack_worlds
from kinetix_dist.actors.unroll import Played, Worlds, unroll
from kinetix_dist.benchmarks.synthetic_batch import ACTIONS
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.evaluation.policies import NetworkPolicy, act, first_memory
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.update import _Program, _shuffled
from kinetix_dist.level.schema import load_level
from kinetix_dist.models import gru
from kinetix_dist.models.gru import Gru, initial_memory, reset_memory
from kinetix_dist.models.policy import PolicyConfig, init_params, make_policy
from kinetix_dist.models.several_policies import SeveralPolicies
from tests.helpers import REPOSITORY, present

STEPS, EPISODE, WORLDS = 9, 4, 4
POLICY = PolicyConfig(network="flat", flat_size=8, hidden_size=8, hidden_layers=1, recurrent="gru", memory_size=6)


@dataclasses.dataclass(frozen=True)
class Problem:
    env: Environment
    policy: nn.Module
    params: Any
    worlds: Worlds
    played: Played


@pytest.fixture(scope="module")
def problem() -> Problem:
    files = sorted((REPOSITORY / "levels" / "s").glob("*.json"))[:2]
    env = Environment(EnvConfig(size="s", max_steps=EPISODE, observation="flat"))
    policy = make_policy(POLICY, env.action_distribution.head_sizes)
    prepared = env.prepare(stack_worlds([load_level(path)[0] for path in files] * (WORLDS // 2)))
    worlds = Worlds(prepared, *env.reset(prepared))
    params = init_params(policy, jax.jit(env.observe)(prepared, worlds.obs), jax.random.key(0))
    # The last layer starts near zero: the memory has to show in the log-probabilities.
    params = jax.tree.map(lambda x: x + 0.3 * jax.random.normal(jax.random.key(1), x.shape), params)
    play = jax.jit(lambda worlds: unroll(policy, params, env, worlds, jax.random.key(2), STEPS))
    return Problem(env, policy, params, worlds, play(worlds))


def test_the_unit_is_that_of_flax() -> None:
    """Flax has the six products apart, under the names of the public package."""
    size, inputs = 5, 3
    x, memory = jax.random.normal(jax.random.key(0), (4, inputs)), jax.random.normal(jax.random.key(1), (4, size))
    theirs = nn.GRUCell(features=size)
    params = theirs.init(jax.random.key(2), memory, x)["params"]
    params = jax.tree.map(lambda p: p + 0.1 * jax.random.normal(jax.random.key(3), p.shape), params)
    ours = {
        "input_kernel": jnp.concatenate([params[name]["kernel"] for name in ("ir", "iz", "in")], axis=1),
        "input_bias": jnp.concatenate([params[name]["bias"] for name in ("ir", "iz", "in")]),
        "memory_kernel": jnp.concatenate([params[name]["kernel"] for name in ("hr", "hz", "hn")], axis=1),
        "memory_bias": params["hn"]["bias"],
    }
    expected, _ = theirs.apply({"params": params}, memory, x)
    found: Any = Gru(size).apply({"params": ours}, x, memory, None)
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_what_is_learned_from_is_what_was_acted(problem: Problem) -> None:
    """The unroll over a stored rollout gives the log-probabilities and values of the acting, across episode ends."""
    trajectory, env = problem.played.trajectory, problem.env
    assert trajectory.done_after[EPISODE - 1].all() and not trajectory.done_after[0].any()
    is_first = np.roll(trajectory.done_after, 1, axis=0)
    is_first[0] = True
    obs = jax.jit(env.observation.join)(problem.worlds.prepared.static_obs, trajectory.dynamic_obs)
    outputs, values = jax.jit(problem.policy.apply)(
        problem.params, obs.reshape(STEPS * WORLDS, -1), is_first=jnp.asarray(is_first)
    )
    actions = trajectory.actions.reshape(STEPS * WORLDS, -1)
    log_probs, _ = jax.jit(env.action_distribution.log_prob_and_entropy)(outputs, actions)
    np.testing.assert_allclose(log_probs.reshape(STEPS, WORLDS), trajectory.log_probs, atol=1e-5)  # another order
    np.testing.assert_allclose(values.reshape(STEPS, WORLDS), trajectory.values, atol=1e-5)  # of float32 sums
    # Without the resets it is another policy: the memory reaches as far.
    never = jnp.zeros((STEPS, WORLDS), bool)
    _, with_memory = jax.jit(problem.policy.apply)(problem.params, obs.reshape(STEPS * WORLDS, -1), is_first=never)
    moved = np.abs(with_memory.reshape(STEPS, WORLDS) - trajectory.values).max(axis=1)
    assert moved[:EPISODE].max() < 1e-5 and moved[EPISODE] > 1e-3


def test_an_evaluation_remembers_as_a_rollout_does(problem: Problem) -> None:
    env, trajectory = problem.env, problem.played.trajectory
    policy = NetworkPolicy(problem.policy, env.action_distribution, greedy=True)
    memory = first_memory(policy, WORLDS)
    keys = jax.random.split(jax.random.key(0), WORLDS)
    seen = [jax.tree.map(lambda x, t=t: x[t], trajectory.dynamic_obs) for t in range(EPISODE)]
    apply = jax.jit(problem.policy.apply)
    state = initial_memory(problem.policy, WORLDS)
    for obs in seen:
        joined = env.observe(problem.worlds.prepared, obs)
        actions, memory = act(policy, problem.params, joined, keys, memory)
        outputs, _, state = apply(problem.params, joined, state)
        np.testing.assert_array_equal(actions, env.action_distribution.mode(outputs))
        np.testing.assert_allclose(present(memory), state, atol=1e-6)
    assert np.abs(present(memory)).max() > 0.01


def test_memory_is_forgotten_where_an_episode_ended() -> None:
    memory = reset_memory(jnp.ones((3, 2)), jnp.array([False, True, False]))
    np.testing.assert_array_equal(memory, [[1, 1], [0, 0], [1, 1]])
    assert reset_memory(None, jnp.array([True])) is None


def test_a_recurrent_policy_without_its_memory_is_an_error(problem: Problem) -> None:
    obs = problem.env.observe(problem.worlds.prepared, problem.worlds.obs)
    with pytest.raises(ValueError, match="acts with its memory"):
        problem.policy.apply(problem.params, obs)


def test_two_students_remember_each_for_itself(problem: Problem) -> None:
    obs = problem.env.observe(problem.worlds.prepared, problem.worlds.obs)
    other = jax.tree.map(lambda x: 0.5 * x, problem.params)
    both = SeveralPolicies(problem.policy, 2, worlds_per_group=4)
    memory = jax.random.normal(jax.random.key(0), (4, both.memory_size))
    _, value, after = both.apply((problem.params, other), obs, memory)
    for params, worlds in ((problem.params, slice(0, 2)), (other, slice(2, 4))):
        _, alone, with_memory = gru.act(problem.policy, params, obs[worlds], memory[worlds])
        np.testing.assert_allclose(value[worlds], alone, atol=1e-6)
        np.testing.assert_allclose(after[worlds], present(with_memory), atol=1e-6)


def test_minibatches_are_whole_worlds_each_once() -> None:
    steps, worlds, config = 3, 8, PpoConfig(epochs=1, minibatches=2, virtual_shards=2)
    program = _Program(make_policy(POLICY, (2,)), OBSERVATIONS["flat"], ACTIONS, config, Division(2, 1))
    index = jax.jit(
        jax.shard_map(
            lambda key: _shuffled(key, steps, worlds, program),
            mesh=jax.make_mesh((1,), ("data",)),
            in_specs=jax.sharding.PartitionSpec(),
            out_specs=jax.sharding.PartitionSpec(),
            check_vma=False,
        )
    )(jax.random.key(0))
    step, world = np.divmod(np.asarray(index).reshape(2, steps, 4), worlds)
    np.testing.assert_array_equal(step, np.broadcast_to(np.arange(steps)[:, None], step.shape))
    assert (world == world[:, :1]).all() and sorted(world[:, 0].ravel()) == list(range(worlds))
    assert (np.sort(world[0, 0] // 4) == [0, 0, 1, 1]).all()  # half of each virtual shard


def test_a_batch_that_gives_no_whole_worlds_is_refused_with_the_numbers() -> None:
    config = PpoConfig(minibatches=4, virtual_shards=8)
    with pytest.raises(
        ValueError, match="16 worlds give 2 to each of 8 virtual shards, which cannot be divided into 4"
    ):
        config.check_batch(num_steps=8, num_worlds=16, whole_worlds=True)
    config.check_batch(num_steps=8, num_worlds=32, whole_worlds=True)
