"""Round that explores: worlds are resampled after every segment, to states near the goal and to rarely seen ones.

    scan of segments:  actions for SEGMENT_STEPS -> steps -> weights of the states -> worlds go on from drawn states

Half of the next worlds are drawn by how near green is to blue, half by how rarely their cell, a coarse description of
the state, was visited in this and earlier rounds of the problem. Worlds that are over are not drawn. In a quarter of
the worlds the policy chooses the actions of a segment, else they are random or go on. Parents are stored, and the
actions of a solution are read backwards along them. (Go-Explore, Ecoffet et al., 2019, on populations.)
"""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.evaluation.planning.held_round import Tally
from kinetix_dist.evaluation.planning.problems import (
    NUM_CELLS,
    Candidates,
    Problems,
    copies,
    earliest_worlds,
    over_actions,
)
from kinetix_dist.evaluation.policies import Policy

SEGMENT_STEPS = 8
POLICY_WORLDS = 4  # one of so many follows the policy
GO_ON_CHANCE = 0.4  # that a segment goes on with the action before it
CHANGE_CHANCE = 0.5  # that the action changes in the middle of a segment
GREEN_CELL_M = 0.15
OTHER_CELL_M = 0.4
SPEED_CELL_M_S = 1.0
ANGLE_CELL_RAD = np.pi / 3
NEARNESS_M = 0.4  # how much farther from blue halves the chance of a state, about
FACTORS = np.random.default_rng(0).integers(0, 2**31, 512, dtype=np.int32) | 1  # of the hash of a cell


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Population:
    """Worlds between two segments, [W, ...], and how they came there, [segments, W, ...]."""

    segment: Array  # [] int32, segments played
    env_state: EnvState
    is_over: Array  # [W] bool
    action: Array  # [W, ...] of the last step
    advice: Array  # [V, ...] actions of the policy for every POLICY_WORLDSth world
    visits: Array  # [S, NUM_CELLS]
    parents: Array  # [segments, W] int32, the world before the segment that a world goes on from
    actions: Array  # [segments, 2, W, ...] of the two halves of each segment
    solved_after: Array  # [segments, W] int32, steps of the episode; 0: not solved in this segment
    distance: Array  # [segments, W] m after each segment, inf of worlds that are over


@functools.partial(jax.jit, static_argnums=(0, 1, 6))
def explore_round(
    env: Environment, policy: Policy, params: Any, problems: Problems, slots: Array, key: Array, num_worlds: int
) -> tuple[Problems, Candidates]:
    """One population of `num_worlds` worlds for each slot [S]. The key is consumed."""
    num_slots, num_segments = slots.shape[0], -(-env.config.max_steps // SEGMENT_STEPS)
    chosen = problems.take(slots)
    prepared, env_state = copies(env, chosen, num_worlds)
    is_movable = _movable(chosen, num_worlds)
    advised = _advised(num_slots * num_worlds)
    static_obs = jax.tree.map(lambda x: x[advised], prepared.static_obs)  # parents are of the same slot

    def advice_of(obs: Any, key: Array) -> Array:
        return policy(params, env.observation.join(static_obs, obs), prng.split(key, len(advised)))

    def goes_on(now: Population) -> Array:
        return (now.segment < num_segments) & ~now.is_over.all()

    def segment(now: Population) -> Population:
        act_key, draw_key, policy_key = prng.split(prng.fold_in(key, now.segment), 3)
        actions = _actions(env, act_key, now)
        env_state, obs, tally = _steps(env, prepared, now, actions)
        cells = _cells(env, prepared, env_state, is_movable)
        distance = jnp.where(tally.is_over, jnp.inf, env_state.distance)
        parents, visits = _resample(draw_key, distance, cells, now.visits)
        next_state, is_over = _worlds(env_state, parents), tally.is_over[parents]
        advice = advice_of(jax.tree.map(lambda x: x[parents[advised]], obs), policy_key)
        return Population(
            segment=now.segment + 1,
            env_state=next_state,
            is_over=is_over,
            action=actions[1][parents],
            advice=advice,
            visits=visits,
            parents=now.parents.at[now.segment + 1].set(parents, mode="drop"),  # none go on from the last segment
            actions=now.actions.at[now.segment].set(actions),
            solved_after=now.solved_after.at[now.segment].set(
                jnp.where(tally.solved_after > 0, now.segment * SEGMENT_STEPS + tally.solved_after, 0)
            ),
            distance=now.distance.at[now.segment].set(distance),
        )

    first = _first(env, chosen, prepared, env_state, num_segments)
    obs = jax.tree.map(lambda x: x[advised], env.obs_of_start(prepared, env_state))
    first = dataclasses.replace(first, advice=advice_of(obs, prng.fold_in(key, num_segments)))
    end = jax.lax.while_loop(goes_on, segment, first)
    new_visits = jnp.zeros_like(problems.visits).at[slots].add(end.visits - chosen.visits)
    problems = dataclasses.replace(problems, visits=problems.visits + new_visits)
    return _results(env, problems, slots, end)


def _first(
    env: Environment, chosen: Problems, prepared: PreparedLevels, env_state: EnvState, num_segments: int
) -> Population:
    total = env_state.num_steps.shape[0]
    noop = env.action_space.noop_actions(total)
    none = jnp.zeros((num_segments, total), jnp.int32)
    return Population(
        segment=jnp.int32(0),
        env_state=env_state,
        is_over=jnp.zeros(total, bool),
        action=noop,
        advice=noop[_advised(total)],
        visits=chosen.visits,
        parents=none + jnp.arange(total, dtype=jnp.int32),
        actions=jnp.zeros((num_segments, 2, *noop.shape), noop.dtype),
        solved_after=none,
        distance=jnp.full((num_segments, total), jnp.inf, jnp.float32),
    )


def _advised(total: int) -> np.ndarray:
    """[V] worlds that follow the policy: some of each slot, of both ways to draw them."""
    return np.arange(0, total, POLICY_WORLDS)


def _actions(env: Environment, key: Array, now: Population) -> Array:
    """[2, W, ...]: actions of the two halves of the next segment."""
    total = now.is_over.shape[0]
    space, (first_key, second_key, on_key, change_key) = env.action_space, prng.split(key, 4)
    goes_on = prng.uniform(on_key, (total,)) < GO_ON_CHANCE
    first = jnp.where(over_actions(goes_on, now.action), now.action, space.sample(first_key, total))
    first = first.at[_advised(total)].set(now.advice)
    changes = prng.uniform(change_key, (total,)) < CHANGE_CHANCE
    second = jnp.where(over_actions(changes, first), space.sample(second_key, total), first)
    return jnp.stack([first, second])


def _steps(env: Environment, prepared: PreparedLevels, now: Population, actions: Array) -> tuple[EnvState, Any, Tally]:
    """State, observation and outcomes after a segment. Only its last step is observed."""

    def step(carry: tuple, number: Array) -> tuple[tuple, None]:
        env_state, tally = carry
        action = jnp.where(number < SEGMENT_STEPS // 2, actions[0], actions[1])
        env_state, _, _, done, info = env.transition(prepared, env_state, action)
        return (env_state, tally.count(number + 1, env_state, done, info)), None

    first = now.env_state, dataclasses.replace(Tally.at_start(now.env_state), is_over=now.is_over)
    (env_state, tally), _ = jax.lax.scan(step, first, jnp.arange(SEGMENT_STEPS - 1, dtype=jnp.int32))
    env_state, obs, _, done, info = env.transition(prepared, env_state, actions[1])
    return env_state, obs, tally.count(jnp.int32(SEGMENT_STEPS), env_state, done, info)


def _movable(chosen: Problems, num_worlds: int) -> Array:
    """[W, n] bool: shapes whose position makes a cell."""
    shapes = chosen.levels.scene.shapes
    return jnp.repeat(jnp.asarray(shapes.active) & (jnp.asarray(shapes.inverse_mass) > 0), num_worlds, axis=0)


def _cells(env: Environment, prepared: PreparedLevels, env_state: EnvState, is_movable: Array) -> Array:
    """[W] int32 below NUM_CELLS: hash of where green is and how it moves, and of where all that moves is."""
    position, angle, velocity, _ = env.engine.bodies(env_state.packed_state)
    green = prepared.roles.is_green.argmax(axis=1)
    world = jnp.arange(green.shape[0])
    others = jnp.where(is_movable[..., None], position, 0.0)
    described = jnp.concatenate(
        [
            position[world, green] / GREEN_CELL_M,
            velocity[world, green] / SPEED_CELL_M_S,
            (angle[world, green, None] % (2 * np.pi)) / ANGLE_CELL_RAD,
            others.reshape(len(world), -1) / OTHER_CELL_M,
        ],
        axis=1,
    )
    finite = jnp.clip(jnp.nan_to_num(described, nan=0.0), -1e4, 1e4)  # worlds that are over do not count
    numbers = jnp.rint(finite).astype(jnp.int32)
    mixed = (numbers * FACTORS[: numbers.shape[1]]).sum(axis=1).astype(jnp.uint32)
    mixed = (mixed ^ (mixed >> 15)) * jnp.uint32(0x2C1B3C6D)
    return ((mixed ^ (mixed >> 13)) % NUM_CELLS).astype(jnp.int32)


def _resample(key: Array, distance: Array, cells: Array, visits: Array) -> tuple[Array, Array]:
    """(parents [W], visits [S, NUM_CELLS]): worlds to go on from, of distances [W] that are inf where it is over."""
    num_slots = visits.shape[0]
    distance, cells = distance.reshape(num_slots, -1), cells.reshape(num_slots, -1)
    num_worlds = distance.shape[1]
    may_go_on = jnp.isfinite(distance)
    slot = jnp.arange(num_slots)[:, None]
    visits = visits.at[slot, cells].add(may_go_on.astype(jnp.float32))
    seen = jnp.take_along_axis(visits, cells, axis=1)
    nearest = distance.min(axis=1, keepdims=True)
    near = jnp.where(may_go_on, jnp.exp(-(distance - nearest) / NEARNESS_M) / (1.0 + seen), 0.0)
    rare = jnp.where(may_go_on, 1.0 / (1.0 + seen) ** 2, 0.0)
    keys = prng.split(key)
    half = num_worlds // 2
    drawn = jnp.concatenate([_draw(keys[0], near, half), _draw(keys[1], rare, num_worlds - half)], axis=1)
    return (drawn + slot * num_worlds).reshape(-1).astype(jnp.int32), visits


def _draw(key: Array, weights: Array, number: int) -> Array:
    """[S, number] int: worlds by their weights [S, P], systematically; evenly where all weights are 0."""
    num_slots, num_worlds = weights.shape
    ends = jnp.cumsum(jnp.where(weights.sum(axis=1, keepdims=True) > 0, weights, 1.0), axis=1)
    at = (jnp.arange(number) + prng.uniform(key, (num_slots, 1))) / number * ends[:, -1:]
    return jnp.minimum(jax.vmap(lambda e, x: jnp.searchsorted(e, x, side="right"))(ends, at), num_worlds - 1)


def _worlds(env_state: EnvState, index: Array) -> EnvState:
    return EnvState(
        packed_state=jax.tree.map(lambda x: x[..., index], env_state.packed_state),
        distance=env_state.distance[index],
        num_steps=env_state.num_steps[index],
        episode_return=env_state.episode_return[index],
    )


def _results(env: Environment, problems: Problems, slots: Array, end: Population) -> tuple[Problems, Candidates]:
    """Solutions and the nearest state of each slot, with the actions that lead there."""
    num_slots, (num_segments, total) = slots.shape[0], end.solved_after.shape
    by_slot = jnp.moveaxis(end.solved_after.reshape(num_segments, num_slots, -1), 1, 0)
    index, solved_after = earliest_worlds(by_slot.reshape(-1), num_slots)
    num_worlds = total // num_slots
    place = index % (num_segments * num_worlds)
    world = place % num_worlds + jnp.arange(num_slots)[:, None] * num_worlds
    solutions = _path(env, end, place // num_worlds, world)

    distance = jnp.moveaxis(end.distance.reshape(num_segments, num_slots, -1), 1, 0).reshape(num_slots, -1)
    best = distance.argmin(axis=1)
    segment, world = best // num_worlds, best % num_worlds + jnp.arange(num_slots) * num_worlds
    base = _path(env, end, segment, world)
    problems = problems.learn(slots, base, jnp.minimum((segment + 1) * SEGMENT_STEPS, len(base)), distance.min(axis=1))
    return problems, Candidates(actions=solutions, solved_after=solved_after)


def _path(env: Environment, end: Population, segment: Array, world: Array) -> Array:
    """[T, *shape, ...]: actions that lead to the states of worlds [*shape] after segments [*shape]; then nothing."""
    num_segments = end.parents.shape[0]
    noop = jnp.full_like(end.actions[0, 0][world], env.action_space.noop)

    def back(world: Array, number: Array) -> tuple[Array, Array]:
        is_on_path = number <= segment
        halves = end.actions[number][:, world]
        halves = jnp.where(over_actions(is_on_path[None], halves), halves, noop[None])
        return jnp.where(is_on_path, end.parents[number][world], world), halves

    _, halves = jax.lax.scan(back, world, jnp.arange(num_segments), reverse=True)
    steps = jnp.repeat(halves.reshape(-1, *halves.shape[2:]), SEGMENT_STEPS // 2, axis=0)
    return steps[: env.config.max_steps]
