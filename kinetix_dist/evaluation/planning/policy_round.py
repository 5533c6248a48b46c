"""Round with the policy: sampled episodes, actions of it that are held, and the policy after a random prefix.

world number % 4    0, 1: the policy; 2: its actions, each held for random durations; 3: the policy after a prefix
prefix              random held actions, or the beginning of the base; up to half of the episode
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.planning.held_round import Tally, nearest
from kinetix_dist.evaluation.planning.problems import (
    NUM_CANDIDATES,
    Candidates,
    Problems,
    copies,
    earliest,
    over_actions,
)
from kinetix_dist.evaluation.planning.proposals import durations, held_actions, is_changed
from kinetix_dist.evaluation.policies import Policy

MIN_HOLD, MAX_HOLD = 2, 16  # environment steps that an action of the policy is held
HELD, AFTER_PREFIX = 2, 3


@functools.partial(jax.jit, static_argnums=(0, 1, 6))
def policy_round(
    env: Environment, policy: Policy, params: Any, problems: Problems, slots: Array, key: Array, num_worlds: int
) -> tuple[Problems, Candidates]:
    """Whole episodes of `num_worlds` worlds of each slot [S]. The key is consumed."""
    num_slots, num_steps = slots.shape[0], env.config.max_steps
    total = num_slots * num_worlds
    chosen = problems.take(slots)
    prepared, env_state = copies(env, chosen, num_worlds)
    hold_key, change_key, prefix_key, act_key = prng.split(key, 4)
    kind = jnp.arange(total) % num_worlds % 4
    hold = jnp.where(kind == HELD, durations(hold_key, total, MIN_HOLD, MAX_HOLD), 1.0)
    changes = is_changed(change_key, hold, num_steps)
    base = jnp.repeat(chosen.base, num_worlds, axis=1)
    base_length = jnp.repeat(chosen.base_length, num_worlds)
    prefix, prefix_length = _prefix(env, prefix_key, base, base_length)
    prefix_length = jnp.where(kind == AFTER_PREFIX, prefix_length, 0)
    keys = jax.vmap(prng.fold_in, in_axes=(None, 0))(act_key, jnp.arange(total))

    def goes_on(carry: tuple) -> Array:
        number, _, _, _, tally = carry
        return (number < num_steps) & tally.goes_on(num_slots, NUM_CANDIDATES)

    def step(carry: tuple) -> tuple:
        number, env_state, obs, played, tally = carry
        step_keys = jax.vmap(prng.fold_in, in_axes=(0, None))(keys, number)
        actions = policy(params, env.observe(prepared, obs), step_keys)
        actions = jnp.where(over_actions(changes[number], actions), actions, played[jnp.maximum(number - 1, 0)])
        actions = jnp.where(over_actions(number < prefix_length, actions), prefix[number], actions)
        env_state, obs, _, done, info = env.transition(prepared, env_state, actions)
        return (
            number + 1,
            env_state,
            obs,
            played.at[number].set(actions),
            tally.count(number + 1, env_state, done, info),
        )

    first = (jnp.int32(0), env_state, env.obs_of_start(prepared, env_state), jnp.zeros_like(prefix))
    *_, played, tally = jax.lax.while_loop(goes_on, step, (*first, Tally.at_start(env_state)))
    learned = problems.learn(slots, *nearest(tally, played, num_slots))
    return learned, earliest(played, tally.solved_after, num_slots)


def _prefix(env: Environment, key: Array, base: Array, base_length: Array) -> tuple[Array, Array]:
    """(actions [T, W, ...], steps of them [W]): random ones, and of every other world the beginning of its base."""
    num_steps, num_worlds = base.shape[:2]
    held_key, length_key = prng.split(key)
    random = held_actions(env.action_space, held_key, num_steps, num_worlds)
    follows = (jnp.arange(num_worlds) // 4 % 2 == 1) & (base_length > 0)
    longest = jnp.where(follows, base_length, num_steps / 2)
    length = (prng.uniform(length_key, (num_worlds,)) * longest).astype(jnp.int32) + 1
    return jnp.where(over_actions(follows[None], base), base, random), length
