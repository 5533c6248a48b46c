"""Counting what becomes of levels while they are rolled out."""

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
        num_finished=count,
        num_solved=count,
        num_failed=count,
        first_solved=count,
        return_sum=jnp.zeros(num_worlds, jnp.float32),
        length_sum=count,
        physics=PhysicsCounts(**dict.fromkeys(PHYSICS_FIELDS, count)),
    )


def add_step(outcome: LevelOutcome, done: Array, info: Any) -> LevelOutcome:
    """Adds the episodes that ended in one step. done [W] bool; info: the environment's StepInfo of that step."""
    return LevelOutcome(
        num_finished=outcome.num_finished + done,
        num_solved=outcome.num_solved + (done & info.solved),
        num_failed=outcome.num_failed + (done & info.failed),
        first_solved=outcome.first_solved + (done & info.solved & (outcome.num_finished == 0)),
        return_sum=outcome.return_sum + jnp.where(done, info.episode_return, 0.0),
        length_sum=outcome.length_sum + jnp.where(done, info.episode_length, 0),
        physics=_add_physics(outcome.physics, info),
    )


def _add_physics(counts: PhysicsCounts, info: Any) -> PhysicsCounts:
    step = {name: getattr(info, name) for name in PHYSICS_FIELDS}
    step["missing_effects"] = step["missing_effects"] != 0  # bits of which effects
    return jax.tree.map(lambda total, count: total + count.astype(jnp.int32), counts, PhysicsCounts(**step))
