"""Random actions that are held for a while, and the levels that they solve: a search that needs no policy.

    keys = episode_keys(key, numbers of levels, numbers of episodes)
    after = solved_after(env, levels, keys)                        [W] steps, 0 where a level is not solved
    after, states = states_on_the_way(env, levels, keys, times)    the same episodes again
    starting_from(levels, states)                                  levels that begin on the way
    held_actions(env, keys, numbers, before)                       what an episode does at a step, for a rollout

An episode is no more than its key: the same key draws the same actions, so that none are stored. Actions change at
random moments, in some episodes often and in some seldom: what needs a motor to run for a second is out of reach of
actions that change in every step. (Dabney et al. 2021, temporally extended exploration.)
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState
from kinetix_dist.level.level import Level

MIN_HOLD, MAX_HOLD = 2, 64  # environment steps; how long an episode holds its actions on average is drawn between them
STATE_NUMBERS = 6  # of a shape: x, y (m), angle (rad), their velocities (m/s, rad/s)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Demonstrations:
    """Worlds that episodes of held actions play, and not the policy."""

    keys: Array  # [W, 2] uint32, data of the keys of episodes
    is_shown: Array  # [W] bool, whether the episode is played


def episode_keys(key: Array, levels: Array, episodes: Array) -> Array:
    """[W] typed keys of episodes, by the number of their level [W] and their own number [W]."""

    def one(level: Array, episode: Array) -> Array:
        return prng.fold_in(prng.fold_in(key, level), episode)

    return jax.vmap(one)(levels.astype(jnp.uint32), episodes.astype(jnp.uint32))


def is_new(key: Array, number: Array) -> Array:
    """[] bool, whether an episode takes another action at its step `number`, which it then holds."""
    hold = jnp.exp(prng.uniform(key, (), np.log(MIN_HOLD), np.log(MAX_HOLD)))
    return prng.uniform(prng.split(prng.fold_in(key, number))[0]) < 1.0 / hold


def held_actions(env: Environment, keys: Array, numbers: Array, before: Array) -> Array:
    """[W, ...] actions of episodes `keys` [W] at their steps `numbers` [W]; before: those of the step before."""

    def draw(key: Array, number: Array) -> tuple[Array, Array]:
        second = prng.split(prng.fold_in(key, number))[1]
        return is_new(key, number) | (number == 0), env.action_space.sample(second, 1)[0]

    changes, drawn = jax.vmap(draw)(keys, numbers.astype(jnp.uint32))
    return jnp.where(changes.reshape(-1, *[1] * (drawn.ndim - 1)), drawn, before)


def solved_after(env: Environment, levels: Level, keys: Array) -> Array:
    """[W] int32: steps after which each level [W, ...] is solved, 0 where its episode ends otherwise. Works in jit."""
    return _play(env, levels, keys, None)[0]


def states_on_the_way(env: Environment, levels: Level, keys: Array, times: Array) -> tuple[Array, Array]:
    """`solved_after`, and states [W, S, n, 6] after `times` [W, S] steps of the same episodes, zeros of later ones."""
    after, states = _play(env, levels, keys, times)
    assert states is not None
    return after, states


def starting_from(levels: Level, states: Array) -> Level:
    """Levels [..., n, ...] that start in states [..., n, 6]. Impulses of joints and contacts begin at zero."""
    return dataclasses.replace(
        levels,
        position=states[..., 0:2],
        angle=states[..., 2],
        velocity=states[..., 3:5],
        angular_velocity=states[..., 5],
    )


def _play(env: Environment, levels: Level, keys: Array, times: Array | None) -> tuple[Array, Array | None]:
    prepared = env.prepare(levels)
    env_state, _ = env.reset(prepared)
    num_worlds = keys.shape[0]

    def step(carry: tuple, number: Array) -> tuple[tuple, None]:
        env_state, actions, is_over, after, states = carry
        if states is not None:
            is_now = (times == number) & ~is_over[:, None]
            states = jnp.where(is_now[..., None, None], _state_of(env, env_state)[:, None], states)
        actions = held_actions(env, keys, jnp.broadcast_to(number, num_worlds), actions)
        env_state, _, _, done, info = env.transition(prepared, env_state, actions)
        after = jnp.where(info.solved & ~is_over, number.astype(jnp.int32) + 1, after)
        return (env_state, actions, is_over | done, after, states), None

    nothing = jnp.zeros_like(env_state.num_steps)
    states = None if times is None else jnp.zeros((*times.shape, env.capacity.shapes, STATE_NUMBERS), jnp.float32)
    first = (env_state, env.action_space.noop_actions(num_worlds), nothing.astype(bool), nothing, states)
    numbers = jnp.arange(env.config.max_steps, dtype=jnp.uint32)
    (_, _, _, after, states), _ = jax.lax.scan(step, first, numbers)
    return after, states


def _state_of(env: Environment, env_state: EnvState) -> Any:
    """[W, n, 6]"""
    position, angle, velocity, angular_velocity = env.engine.bodies(env_state.packed_state)
    return jnp.concatenate([position, angle[..., None], velocity, angular_velocity[..., None]], axis=-1)
