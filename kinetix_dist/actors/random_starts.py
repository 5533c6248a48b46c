"""Exploring starts: some worlds begin an update after random actions, from states that the policy does not get into.

A policy that stands still where it should walk never sees what comes after the first step, and no gradient tells it.
From a state of random actions it may go on to solve the level, and what is worth something is then learned backwards:
"exploring starts" (Sutton and Barto, section 5.3). Nothing is learned from the random actions themselves.

A world is chosen with chance `share`. It takes 1 to `max_steps` random steps, and each action is held for the same 1 to
MAX_HOLD steps: single steps of random actions cancel each other. Time and return of the episode count on; an episode
that ends meanwhile begins again, as everywhere.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.actors.unroll import keys_of_worlds
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels

MAX_HOLD = 16


def after_random_actions(
    env: Environment,
    prepared: PreparedLevels,
    env_state: EnvState,
    obs: Any,
    key: Array,
    numbers: Array,
    *,
    share: float,
    max_steps: int,
) -> tuple[EnvState, Any]:
    """What `env.reset` gave, for W worlds, or what random actions made of it.

    key: a typed key, used up. numbers: [W] of these worlds in the whole batch; what happens to a world depends on the
    key and its number alone.
    """
    keys = keys_of_worlds(key, numbers)
    draw_keys, action_keys = jax.vmap(prng.split, out_axes=1)(keys)
    coin, length, hold = jax.vmap(lambda key: prng.uniform(key, (3,)), out_axes=1)(draw_keys)
    num_steps = jnp.where(coin < share, 1 + jnp.floor(length * max_steps).astype(jnp.int32), 0)
    held_for = 1 + jnp.floor(hold * MAX_HOLD).astype(jnp.int32)

    def step(carry: tuple[EnvState, Any], number: Array) -> tuple[tuple[EnvState, Any], None]:
        step_keys = jax.vmap(prng.fold_in)(action_keys, number // held_for)
        actions = jax.vmap(lambda key: env.action_space.sample(key, 1)[0])(step_keys)
        after, after_obs, _, _, _ = env.step(prepared, carry[0], actions)
        return env.select(prepared, number < num_steps, (after, after_obs), carry), None

    return jax.lax.scan(step, (env_state, obs), jnp.arange(max_steps))[0]
