"""Discrete actions: one of 11 a world, [W] int32, with the numbers of the public package (kinetix-env 3.0.2).

2 c and 2 c + 1 drive motor colour c backward and forward, 8 nothing, 9 and 10 a thruster colour.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.action_spaces.categorical import OneCategorical
from kinetix_dist.env.action_spaces.space import MOTOR_NAMES, THRUSTER_NAMES, ActionSpace
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS
from kinetix_dist.telemetry.recording import ActionName

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

    @property
    def action_names(self) -> tuple[ActionName, ...]:
        motors = (f"{name} {way}" for name in MOTOR_NAMES for way in ("backward", "forward"))
        return (ActionName("choice", (*motors, "nothing", *(f"{name} on" for name in THRUSTER_NAMES))),)

    def colour_values(self, actions: Array, allowed: Array) -> tuple[Array, Array]:
        choice = jnp.where(allowed, actions, NOOP)[:, None]
        colours = jnp.arange(NUM_MOTOR_COLOURS)
        motor = (choice == 2 * colours + 1).astype(jnp.float32) - (choice == 2 * colours)
        thruster = choice == jnp.arange(NUM_THRUSTER_COLOURS) + NOOP + 1
        return motor, thruster.astype(jnp.float32)
