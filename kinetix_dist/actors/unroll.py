"""Rolling a policy out: environment steps in one compiled scan, samples that do not depend on where a world lies.

    unroll()    T steps of W worlds -> Trajectory, outcomes of levels; what the learner trains on
    score()     the same steps, keeping only the outcomes; what the curator ranks levels by

Both are pure and work inside jit and shard_map. The random numbers of world i at step t depend on the key, on i and
on t only. World numbers are those of the whole batch, so that one device or eight draw the same actions.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.actors.outcomes import add_step, no_outcomes
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.observations.entities import observe
from kinetix_dist.messages import LevelOutcome, Trajectory
from kinetix_dist.models import heads


def unroll(
    policy: nn.Module,
    params: Any,
    env: Environment,
    prepared: Any,
    env_state: Any,
    obs: Any,
    key: Array,
    num_steps: int,
    *,
    first_world: Array | int = 0,
) -> tuple[Trajectory, Any, Any, Array, LevelOutcome]:
    """`num_steps` steps: (trajectory, env_state, obs, last_value [W], outcomes of the episodes that ended).

    obs: DynamicObs [W, ...] as `env.reset` or the last unroll gave it. key: a typed key, used up by this call (fold in
    a counter for the next). first_world: number of the first of these worlds in the whole batch.
    """
    num_worlds = _num_worlds(obs)
    world_keys = _world_keys(key, first_world, num_worlds)

    def step(carry: tuple[Any, Any, LevelOutcome], number: Array) -> tuple[tuple[Any, Any, LevelOutcome], Trajectory]:
        env_state, obs, outcome = carry
        logits, value = policy.apply(params, observe(prepared.static_obs, obs))
        actions, log_prob = heads.sample(logits, _uniforms(world_keys, number, len(logits)))
        env_state, next_obs, reward, done, info = env.step(prepared, env_state, actions)
        taken = Trajectory(
            dynamic_obs=obs,
            actions=actions.astype(jnp.int8),
            log_probs=log_prob,
            values=value,
            rewards=reward,
            done_after=done,
        )
        return (env_state, next_obs, add_step(outcome, done, info)), taken

    carry = (env_state, obs, no_outcomes(num_worlds))
    (env_state, obs, outcome), trajectory = jax.lax.scan(step, carry, jnp.arange(num_steps, dtype=jnp.uint32))
    _, last_value = policy.apply(params, observe(prepared.static_obs, obs))
    return trajectory, env_state, obs, last_value, outcome


def score(
    policy: nn.Module,
    params: Any,
    env: Environment,
    prepared: Any,
    key: Array,
    num_steps: int,
    *,
    first_world: Array | int = 0,
) -> LevelOutcome:
    """Outcomes of the episodes that end within `num_steps` steps from the start of each level. Keeps no trajectory."""
    env_state, obs = env.reset(prepared)
    num_worlds = _num_worlds(obs)
    world_keys = _world_keys(key, first_world, num_worlds)

    def step(carry: tuple[Any, Any, LevelOutcome], number: Array) -> tuple[tuple[Any, Any, LevelOutcome], None]:
        env_state, obs, outcome = carry
        logits, _ = policy.apply(params, observe(prepared.static_obs, obs))
        actions, _ = heads.sample(logits, _uniforms(world_keys, number, len(logits)))
        env_state, obs, _, done, info = env.step(prepared, env_state, actions)
        return (env_state, obs, add_step(outcome, done, info)), None

    carry = (env_state, obs, no_outcomes(num_worlds))
    (_, _, outcome), _ = jax.lax.scan(step, carry, jnp.arange(num_steps, dtype=jnp.uint32))
    return outcome


def _num_worlds(obs: Any) -> int:
    return jax.tree.leaves(obs)[0].shape[0]


def _world_keys(key: Array, first_world: Array | int, num_worlds: int) -> Array:
    worlds = jnp.arange(num_worlds, dtype=jnp.uint32) + jnp.asarray(first_world, jnp.uint32)
    return jax.vmap(jax.random.fold_in, (None, 0))(key, worlds)


def _uniforms(world_keys: Array, step: Array, num_heads: int) -> Array:
    """[W, heads] uniform numbers in [0, 1)."""
    return jax.vmap(lambda key: jax.random.uniform(jax.random.fold_in(key, step), (num_heads,)))(world_keys)
