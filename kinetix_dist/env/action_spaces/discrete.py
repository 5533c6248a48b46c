"""Discrete actions: one of 11 a world, [W] int32: a motor colour forward (0-3) or backward (4-7), nothing (8), a
thruster colour (9, 10)."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.action_spaces.categorical import OneCategorical
from kinetix_dist.env.action_spaces.space import ActionSpace
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS

NOOP = 2 * NUM_MOTOR_COLOURS  # two directions of each motor colour come before it


@dataclasses.dataclass(frozen=True, kw_only=True)
class Discrete(ActionSpace):
    """One colour at a time."""

    name: str = "discrete"
    low: tuple[float, ...] = (0,)
    high: tuple[float, ...] = (NOOP + NUM_THRUSTER_COLOURS,)
    is_integer: bool = True
    is_flat: bool = True
    noop: int = NOOP

    @property
    def distribution(self) -> OneCategorical:
        return OneCategorical(num_choices=int(self.high[0]) + 1)

    def colour_values(self, actions: Array, allowed: Array) -> tuple[Array, Array]:
        choice = jnp.where(allowed, actions, NOOP)[:, None]
        colours = jnp.arange(NUM_MOTOR_COLOURS)
        motor = (choice == colours).astype(jnp.float32) - (choice == colours + NUM_MOTOR_COLOURS)
        thruster = choice == jnp.arange(NUM_THRUSTER_COLOURS) + NOOP + 1
        return motor, thruster.astype(jnp.float32)
