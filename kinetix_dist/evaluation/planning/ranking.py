"""Ranking of solutions: the share of slightly different states from which the same actions still solve."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.planning.held_round import play_sequences
from kinetix_dist.evaluation.planning.problems import Candidates, Problems, over_actions, state_of
from kinetix_dist.level.level import Level

START_NOISE_M, START_NOISE_RAD = 1e-3, 1e-3  # standard deviations; resting shapes overlap by 5 mm
ENOUGH = 0.97  # robustness beyond which shorter is better, as of proofs


def perturbed(levels: Level, key: Array) -> Level:
    """Levels [W, ...] whose movable shapes start elsewhere by noise. The key is consumed; one world, one draw."""
    shapes = levels.scene.shapes
    is_movable = jnp.asarray(shapes.active) & (jnp.asarray(shapes.inverse_mass) > 0)
    place_key, turn_key = prng.split(key)
    moved = START_NOISE_M * prng.normal(place_key, jnp.shape(levels.position))
    turned = START_NOISE_RAD * prng.normal(turn_key, jnp.shape(levels.angle))
    return dataclasses.replace(
        levels,
        position=levels.position + jnp.where(is_movable[..., None], moved, 0.0),
        angle=levels.angle + jnp.where(is_movable, turned, 0.0),
    )


@functools.partial(jax.jit, static_argnums=(0, 5))
def robustness(
    env: Environment, problems: Problems, slots: Array, candidates: Candidates, key: Array, num_worlds: int
) -> Array:
    """[S, C]: share of `num_worlds` / C perturbed states that each candidate solves. The key is consumed."""
    num_slots, num_candidates = candidates.solved_after.shape
    tries = num_worlds // num_candidates
    repeated = num_candidates * tries
    chosen = problems.take(slots)
    position, angle, velocity, angular_velocity = env.engine.bodies(chosen.packed_state)
    levels = dataclasses.replace(
        chosen.levels, position=position, angle=angle, velocity=velocity, angular_velocity=angular_velocity
    )
    levels = perturbed(jax.tree.map(lambda x: jnp.repeat(jnp.asarray(x), repeated, axis=0), levels), key)
    prepared = env.prepare(levels)
    num_steps = jnp.repeat(chosen.num_steps, repeated)
    env_state = state_of(env, prepared, prepared.initial_packed_state, num_steps)
    actions = candidates.actions.reshape(len(candidates.actions), -1, *candidates.actions.shape[3:])
    actions = jnp.repeat(actions, tries, axis=1)
    after = jnp.repeat(candidates.solved_after.reshape(-1), tries)
    is_played = jnp.arange(len(actions))[:, None] < after
    actions = jnp.where(over_actions(is_played, actions), actions, jnp.asarray(env.action_space.noop, actions.dtype))
    tally = play_sequences(env, prepared, env_state, actions, num_slots, enough=repeated + 1)
    return (tally.solved_after > 0).reshape(num_slots, num_candidates, tries).mean(axis=2)
