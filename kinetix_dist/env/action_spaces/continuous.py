"""Continuous actions: four motor colours -1..1, two thruster colours 0..1; [W, 6] float32."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.action_spaces.space import MOTOR_NAMES, THRUSTER_NAMES, ActionSpace, bound_colours
from kinetix_dist.env.action_spaces.truncated_normal import TruncatedNormal
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, Level
from kinetix_dist.telemetry.recording import ActionName


@dataclasses.dataclass(frozen=True, kw_only=True)
class Continuous(ActionSpace):
    """Numbers pass through as they are."""

    name: str = "continuous"
    low: tuple[float, ...] = (-1.0,) * NUM_MOTOR_COLOURS + (0.0,) * NUM_THRUSTER_COLOURS
    high: tuple[float, ...] = (1.0,) * (NUM_MOTOR_COLOURS + NUM_THRUSTER_COLOURS)
    is_integer: bool = False

    @property
    def distribution(self) -> TruncatedNormal:
        return TruncatedNormal(low=self.low, high=self.high)

    @property
    def action_names(self) -> tuple[ActionName, ...]:
        return tuple(map(ActionName, (*MOTOR_NAMES, *THRUSTER_NAMES)))

    def colour_values(self, actions: Array, allowed: Array) -> tuple[Array, Array]:
        actions = jnp.where(allowed, actions, 0)
        return actions[:, :NUM_MOTOR_COLOURS].astype(jnp.float32), actions[:, NUM_MOTOR_COLOURS:].astype(jnp.float32)

    def bound_heads(self, levels: Level) -> Array:
        return bound_colours(levels)
