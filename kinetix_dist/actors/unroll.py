"""Rolling a policy out: environment steps in one compiled scan, samples that do not depend on where a world lies.

    unroll()    T steps of W worlds -> Trajectory, outcomes of levels; what the learner trains on
    score()     the same steps, keeping only the outcomes; what the curator ranks levels by

Both are pure and work inside jit and shard_map. The random numbers of world i at step t depend on the key, on i and
on t only. World numbers are those of the whole batch, so that one device or eight draw the same actions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax.experimental.layout import Layout, with_layout_constraint

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.actors import invariants
from kinetix_dist.actors.outcomes import add_step, no_outcomes
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.messages import LevelOutcome, Trajectory
from kinetix_dist.models.gru import act, initial_memory, reset_memory


class Worlds(NamedTuple):
    """State of a batch of worlds."""

    prepared: PreparedLevels
    env_state: EnvState
    obs: Any  # [W, ...], as `env.reset` or the last unroll gave it
    numbers: Array | None = None  # [W] of these worlds in the whole batch; None: from 0 on
    bound_heads: Array | None = None  # [W, dimensions] bool, those whose log-probability counts; None: all
    memory: Array | None = None  # [W, size] of the policy; None: that at the start of an episode


class Played(NamedTuple):
    """Result of `unroll`."""

    trajectory: Trajectory
    env_state: EnvState
    obs: Any
    memory: Array | None  # [W, size] after the last step; None: the policy has none
    last_value: Array  # [W]
    outcome: LevelOutcome  # of the episodes that ended


def unroll(
    policy: nn.Module,
    params: Any,
    env: Environment,
    worlds: Worlds,
    key: Array,
    num_steps: int,
    *,
    keep_timeouts: bool = False,
) -> Played:
    """`num_steps` steps of W worlds from the states that they are in.

    key: a typed key, or one a world, used up by this call (fold in a counter for the next). keep_timeouts: whether the
    trajectory says which episodes ended at the time limit.
    """
    prepared = worlds.prepared
    counted = {} if worlds.bound_heads is None else {"bound": worlds.bound_heads}
    distribution = env.action_distribution
    num_worlds = _num_worlds(worlds.obs)
    world_keys = keys_of_worlds(key, jnp.arange(num_worlds) if worlds.numbers is None else worlds.numbers)

    @jax.jit  # traced once for the steps and for the value behind the last one
    def play(params: Any, obs: Any, memory: Array | None) -> tuple[Any, Array, Array | None]:
        return act(policy, params, obs, memory)

    def step(carry: tuple, number: Array) -> tuple[tuple, Trajectory]:
        env_state, obs, memory, outcome = carry
        outputs, value, memory = play(params, env.observe(prepared, obs), memory)
        uniforms = _uniforms(world_keys, number, distribution.num_uniforms)
        actions, log_prob = distribution.sample(outputs, uniforms, **counted)
        env_state, next_obs, reward, done, info = env.step(prepared, env_state, actions)
        taken = Trajectory(
            dynamic_obs=jax.tree.map(_world_by_world, obs),
            actions=actions.astype(distribution.stored_dtype),
            log_probs=log_prob,
            values=value,
            rewards=reward,
            done_after=done,
            timed_out=info.timed_out if keep_timeouts else None,
        )
        return (env_state, next_obs, reset_memory(memory, done), add_step(outcome, done, info)), taken

    memory = initial_memory(policy, num_worlds) if worlds.memory is None else worlds.memory
    carry = (worlds.env_state, worlds.obs, memory, no_outcomes(num_worlds))
    (env_state, obs, memory, outcome), trajectory = invariants.scan(
        step, carry, jnp.arange(num_steps, dtype=jnp.uint32)
    )
    _, last_value, _ = play(params, env.observe(prepared, obs), memory)
    return Played(trajectory, env_state, obs, memory, last_value, outcome)


def score(
    policy: nn.Module,
    params: Any,
    env: Environment,
    prepared: PreparedLevels,
    key: Array,
    num_steps: int,
) -> LevelOutcome:
    """Outcomes of the episodes that end within `num_steps` steps from the start of each level. Keeps no trajectory."""
    distribution = env.action_distribution
    env_state, obs = env.reset(prepared)
    num_worlds = _num_worlds(obs)
    world_keys = keys_of_worlds(key, jnp.arange(num_worlds))

    def step(carry: tuple, number: Array) -> tuple[tuple, None]:
        env_state, obs, memory, outcome = carry
        outputs, _, memory = act(policy, params, env.observe(prepared, obs), memory)
        actions, _ = distribution.sample(outputs, _uniforms(world_keys, number, distribution.num_uniforms))
        env_state, obs, _, done, info = env.step(prepared, env_state, actions)
        return (env_state, obs, reset_memory(memory, done), add_step(outcome, done, info)), None

    carry = (env_state, obs, initial_memory(policy, num_worlds), no_outcomes(num_worlds))
    (_, _, _, outcome), _ = invariants.scan(step, carry, jnp.arange(num_steps, dtype=jnp.uint32))
    return outcome


def _world_by_world(x: Array) -> Array:
    """`x` as the learner takes it, each world's numbers side by side in memory.

    Without it XLA keeps the trajectory as the engine's tables are, worlds last, and transposes it after the last step:
    a second copy (at M 159 KiB a world instead of 102, docs/operating.md: memory of GPUs).
    """
    return with_layout_constraint(x, Layout(major_to_minor=tuple(range(x.ndim))))


def _num_worlds(obs: Any) -> int:
    return jax.tree.leaves(obs)[0].shape[0]


def keys_of_worlds(key: Array, numbers: Array) -> Array:
    """[W] typed keys, each by the number of a world in the whole batch. key: of all worlds, or [W]."""
    return jax.vmap(prng.fold_in, (0 if key.ndim else None, 0))(key, numbers.astype(jnp.uint32))


def _uniforms(world_keys: Array, step: Array, count: int) -> Array:
    """[W, count] uniform numbers in [0, 1)."""
    return jax.vmap(lambda key: prng.uniform(prng.fold_in(key, step), (count,)))(world_keys)
