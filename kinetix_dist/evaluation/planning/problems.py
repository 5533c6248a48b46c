"""Planning problems: a level, the state to go on from, and what the search has learned of it.

    slots = active[arange(G) % len(active)]        a problem without a plan may have several slots
    problems.take(slots) -> num_worlds copies of each slot -> candidates of each slot, problems that learned

Worlds are ordered by slot: worlds g * P to (g + 1) * P are copies of slot g. Works inside jit.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.outcome import goal_distance
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.level.level import Level

NUM_CELLS = 2**14  # of a problem, see explore_round.py
NUM_CANDIDATES = 16  # solutions of a slot that a round hands on, the earliest
NEVER = 2**30  # steps; later than any episode ends
RED_COST_M = 0.5  # what an episode that ends without a solution loses against one that does not end


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Problems:
    """Batch of problems, [G, ...]. The base is the sequence of actions that brought green nearest to blue so far."""

    levels: Level  # [G, ...]
    packed_state: Any  # jax2d packed state, [field, G]
    num_steps: Array  # [G] int32, environment steps that the episode has taken before
    base: Array  # [T, G, ...] actions
    base_length: Array  # [G] int32, steps of it until green was nearest
    base_cost: Array  # [G] float32 m, distance of the centres then, RED_COST_M more where the episode ended
    visits: Array  # [G, NUM_CELLS] float32, worlds that came through each cell

    def take(self, slots: Array) -> Problems:
        return Problems(
            levels=jax.tree.map(lambda x: jnp.asarray(x)[slots], self.levels),
            packed_state=jax.tree.map(lambda x: x[..., slots], self.packed_state),
            num_steps=self.num_steps[slots],
            base=self.base[:, slots],
            base_length=self.base_length[slots],
            base_cost=self.base_cost[slots],
            visits=self.visits[slots],
        )

    def learn(self, slots: Array, base: Array, base_length: Array, base_cost: Array) -> Problems:
        """Takes over the bases of the slots, [T, S, ...], [S] and [S], where they are nearer."""
        is_of = jnp.arange(self.base_cost.shape[0])[:, None] == slots
        costs = jnp.where(is_of, base_cost, jnp.inf)
        best, is_nearer = costs.argmin(axis=1), costs.min(axis=1) < self.base_cost
        return dataclasses.replace(
            self,
            base=jnp.where(over_actions(is_nearer[None], base), base[:, best], self.base),
            base_length=jnp.where(is_nearer, base_length[best], self.base_length),
            base_cost=jnp.where(is_nearer, base_cost[best], self.base_cost),
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Candidates:
    """Solutions of each slot, the earliest first."""

    actions: Array  # [T, S, C, ...]
    solved_after: Array  # [S, C] int32, steps from the start of the problem; 0: no solution


def problems_at(env: Environment, levels: Level, packed_state: Any, num_steps: Array) -> Problems:
    """Problems of which nothing is known yet."""
    number = num_steps.shape[0]
    noop = env.action_space.noop_actions(number)
    return Problems(
        levels=levels,
        packed_state=packed_state,
        num_steps=jnp.asarray(num_steps, jnp.int32),
        base=jnp.broadcast_to(noop, (env.config.max_steps, *noop.shape)),
        base_length=jnp.zeros(number, jnp.int32),
        base_cost=jnp.full(number, jnp.inf, jnp.float32),
        visits=jnp.zeros((number, NUM_CELLS), jnp.float32),
    )


def copies(env: Environment, problems: Problems, num_worlds: int) -> tuple[PreparedLevels, EnvState]:
    """`num_worlds` worlds of each problem, in its state."""
    prepared = env.prepare(jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x), num_worlds, axis=0), problems.levels))
    packed_state = jax.tree.map(lambda x: jnp.repeat(x, num_worlds, axis=-1), problems.packed_state)
    return prepared, state_of(env, prepared, packed_state, jnp.repeat(problems.num_steps, num_worlds))


def state_of(env: Environment, prepared: PreparedLevels, packed_state: Any, num_steps: Array) -> EnvState:
    distance = goal_distance(env.engine.bodies(packed_state)[0], prepared.roles)
    return EnvState(
        packed_state=packed_state, distance=distance, num_steps=num_steps, episode_return=jnp.zeros_like(distance)
    )


def earliest(actions: Array, solved_after: Array, num_slots: int) -> Candidates:
    """Candidates of each slot among all worlds: actions [T, W, ...], solved_after [W]."""
    index, after = earliest_worlds(solved_after, num_slots)
    return Candidates(actions=actions[:, index], solved_after=after)


def earliest_worlds(solved_after: Array, num_slots: int) -> tuple[Array, Array]:
    """(worlds [S, C], their solved_after [S, C]) that are solved first, of solved_after [W]; 0 where none is."""
    by_slot = jnp.where(solved_after > 0, solved_after, NEVER).reshape(num_slots, -1)
    negative, index = jax.lax.top_k(-by_slot, min(NUM_CANDIDATES, by_slot.shape[1]))
    first = jnp.arange(num_slots)[:, None] * by_slot.shape[1]
    return first + index, jnp.where(-negative < NEVER, -negative, 0)


def over_actions(mask: Array, actions: Array) -> Array:
    """A mask [...] of worlds with the trailing axes of their actions [..., A] or [...]."""
    return mask.reshape(*mask.shape, *[1] * (actions.ndim - mask.ndim))
