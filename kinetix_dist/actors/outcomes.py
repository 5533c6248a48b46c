"""Counting what becomes of levels while they are rolled out.

A world starts its level again whenever an episode ends, so a world with short episodes finishes more of them. Solved /
finished summed over worlds is then no solve rate. Say that p is 1/2, that a solved episode lasts 1 step and another one
all 8 that are played: half of the worlds finish one episode, not solved, the others two on average, all solved. That is
2 of 3, not 1 of 2.

    first episodes   each world begins one. Solved ones / worlds has the mean p, and worlds are independent
    one world        solved / finished has the mean p too, where an episode always finishes: given how many do, the
                     first is solved as often as any. It is noisy, so that p (1 - p) of it is too low on average, and
                     too high among the levels that were chosen by it

A first episode that has not ended with the last step counts as not solved: where an episode may have more steps than
are played, solved first episodes / worlds is the chance to solve a level within the steps that are played. Steps are
those from one reset of the worlds to the next: where worlds go on from update to update (`rollout.reset_every`), the
outcomes of its updates are `joined`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.messages import LevelOutcome, PhysicsCounts

PHYSICS_FIELDS = tuple(field.name for field in dataclasses.fields(PhysicsCounts))


def no_outcomes(num_worlds: int) -> LevelOutcome:
    """Nothing has finished yet."""
    count = jnp.zeros(num_worlds, jnp.int32)
    return LevelOutcome(
        first_solved=count,
        first_failed=count,
        first_return=jnp.zeros(num_worlds, jnp.float32),
        num_finished=count,
        num_solved=count,
        return_sum=jnp.zeros(num_worlds, jnp.float32),
        length_sum=count,
        physics=PhysicsCounts(**dict.fromkeys(PHYSICS_FIELDS, count)),
    )


def add_step(outcome: LevelOutcome, done: Array, info: Any) -> LevelOutcome:
    """Adds the episodes that ended in one step. done [W] bool; info: the environment's StepInfo of that step."""
    is_first = outcome.num_finished == 0
    return LevelOutcome(
        first_solved=outcome.first_solved + (is_first & done & info.solved),
        first_failed=outcome.first_failed + (is_first & done & info.failed),
        first_return=jnp.where(is_first, info.episode_return, outcome.first_return),
        num_finished=outcome.num_finished + done,
        num_solved=outcome.num_solved + (done & info.solved),
        return_sum=outcome.return_sum + jnp.where(done, info.episode_return, 0.0),
        length_sum=outcome.length_sum + jnp.where(done, info.episode_length, 0),
        physics=_add_physics(outcome.physics, info),
    )


def joined(before: LevelOutcome, after: LevelOutcome) -> LevelOutcome:
    """Outcomes of the steps of `before` and of those of `after`, which went on from there."""
    had_ended = before.num_finished > 0
    sums = ("num_finished", "num_solved", "return_sum", "length_sum")
    firsts = ("first_solved", "first_failed", "first_return")
    return LevelOutcome(
        **{name: jnp.where(had_ended, getattr(before, name), getattr(after, name)) for name in firsts},
        **{name: getattr(before, name) + getattr(after, name) for name in sums},
        physics=jax.tree.map(jnp.add, before.physics, after.physics),
    )


def _add_physics(counts: PhysicsCounts, info: Any) -> PhysicsCounts:
    step = {name: getattr(info, name) for name in PHYSICS_FIELDS}
    step["missing_effects"] = step["missing_effects"] != 0  # bits of which effects
    return jax.tree.map(lambda total, count: total + count.astype(jnp.int32), counts, PhysicsCounts(**step))
