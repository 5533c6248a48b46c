"""Round without the policy: half of the worlds play random held actions, half variants of the base.

The engine alone steps, no observation is computed: tens of times as many episodes a second as with the policy.
"""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels, StepInfo
from kinetix_dist.evaluation.planning.problems import (
    NUM_CANDIDATES,
    RED_COST_M,
    Candidates,
    Problems,
    copies,
    earliest,
    over_actions,
)
from kinetix_dist.evaluation.planning.proposals import held_actions, variants


@functools.partial(jax.jit, static_argnums=(0, 4))
def held_round(
    env: Environment, problems: Problems, slots: Array, key: Array, num_worlds: int
) -> tuple[Problems, Candidates]:
    """Whole episodes of `num_worlds` worlds of each slot [S]. The key is consumed."""
    num_slots = slots.shape[0]
    chosen = problems.take(slots)
    prepared, env_state = copies(env, chosen, num_worlds)
    held_key, variant_key = prng.split(key)
    total, num_steps = num_slots * num_worlds, env.config.max_steps
    actions = held_actions(env.action_space, held_key, num_steps, total)
    base, length = jnp.repeat(chosen.base, num_worlds, axis=1), jnp.repeat(chosen.base_length, num_worlds)
    varied = variants(env.action_space, variant_key, base, length)
    number = jnp.arange(total) % num_worlds
    actions = jnp.where(over_actions((number % 2 == 1)[None], actions), varied, actions)
    # The base itself is tried too: where a plan was made for another start, it may still do.
    is_base = (number == 0)[None] & (jnp.arange(num_steps)[:, None] < length)
    actions = jnp.where(over_actions(is_base, actions), base, actions)
    tally = play_sequences(env, prepared, env_state, actions, num_slots)
    learned = problems.learn(slots, *nearest(tally, actions, num_slots))
    return learned, earliest(actions, tally.solved_after, num_slots)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Tally:
    """Outcome of each world so far, [W]."""

    is_over: Array  # bool
    solved_after: Array  # int32, steps; 0: not solved
    nearest: Array  # float32 m, of the centres of green and blue
    nearest_after: Array  # int32, steps

    @classmethod
    def at_start(cls, env_state: EnvState) -> Tally:
        zeros = jnp.zeros_like(env_state.num_steps)
        return cls(
            is_over=env_state.num_steps < 0,
            solved_after=zeros,
            nearest=jnp.full_like(env_state.distance, jnp.inf),
            nearest_after=zeros,
        )

    def count(self, step: Array, env_state: EnvState, done: Array, info: StepInfo) -> Tally:
        """After the step of this number, from 1."""
        is_nearer = ~self.is_over & (env_state.distance < self.nearest)  # NaN is not near
        return Tally(
            is_over=self.is_over | done,
            solved_after=jnp.where(info.solved & ~self.is_over, step, self.solved_after),
            nearest=jnp.where(is_nearer, env_state.distance, self.nearest),
            nearest_after=jnp.where(is_nearer, step, self.nearest_after),
        )

    def goes_on(self, num_slots: int, enough: int) -> Array:
        """[] bool: some world is not over, and some slot has fewer than `enough` solutions."""
        num_solved = (self.solved_after > 0).reshape(num_slots, -1).sum(axis=1)
        return ~self.is_over.all() & (num_solved < enough).any()


def play_sequences(
    env: Environment,
    prepared: PreparedLevels,
    env_state: EnvState,
    actions: Array,
    num_slots: int,
    enough: int = NUM_CANDIDATES,
) -> Tally:
    """Plays actions [T, W, ...] until every world is over, or every slot has `enough` solutions."""

    def goes_on(carry: tuple) -> Array:
        number, _, tally = carry
        return (number < actions.shape[0]) & tally.goes_on(num_slots, enough)

    def step(carry: tuple) -> tuple:
        number, env_state, tally = carry
        env_state, _, _, done, info = env.transition(prepared, env_state, actions[number])
        return number + 1, env_state, tally.count(number + 1, env_state, done, info)

    return jax.lax.while_loop(goes_on, step, (jnp.int32(0), env_state, Tally.at_start(env_state)))[2]


def nearest(tally: Tally, actions: Array, num_slots: int) -> tuple[Array, Array, Array]:
    """(base [T, S, ...], its length [S], its cost [S]) of each slot: the world that came nearest."""
    cost = tally.nearest + RED_COST_M * (tally.is_over & (tally.solved_after == 0))
    by_slot = cost.reshape(num_slots, -1)
    world = by_slot.argmin(axis=1) + jnp.arange(num_slots) * by_slot.shape[1]
    return actions[:, world], tally.nearest_after[world], cost[world]
