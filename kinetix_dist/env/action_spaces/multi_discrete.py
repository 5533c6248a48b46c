"""Multi-discrete actions, the paper's, [W, 6] int32: four motor colours {0 off, 1 forward, 2 backward}, two thruster
colours {0 off, 1 on}."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.action_spaces.categorical import Categorical
from kinetix_dist.env.action_spaces.space import MOTOR_NAMES, THRUSTER_NAMES, ActionSpace, bound_colours
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, Level
from kinetix_dist.telemetry.recording import ActionName


@dataclasses.dataclass(frozen=True, kw_only=True)
class MultiDiscrete(ActionSpace):
    """A choice for each colour; colours are independent."""

    name: str = "multi_discrete"
    low: tuple[float, ...] = (0,) * (NUM_MOTOR_COLOURS + NUM_THRUSTER_COLOURS)
    high: tuple[float, ...] = (2,) * NUM_MOTOR_COLOURS + (1,) * NUM_THRUSTER_COLOURS
    is_integer: bool = True

    @property
    def distribution(self) -> Categorical:
        return Categorical(head_sizes=tuple(int(high) + 1 for high in self.high))

    @property
    def action_names(self) -> tuple[ActionName, ...]:
        motors = (ActionName(name, ("off", "forward", "backward")) for name in MOTOR_NAMES)
        return (*motors, *(ActionName(name, ("off", "on")) for name in THRUSTER_NAMES))

    def colour_values(self, actions: Array, allowed: Array) -> tuple[Array, Array]:
        actions = jnp.where(allowed, actions, 0)
        motor, thruster = actions[:, :NUM_MOTOR_COLOURS], actions[:, NUM_MOTOR_COLOURS:]
        return (motor == 1).astype(jnp.float32) - (motor == 2), thruster.astype(jnp.float32)

    def bound_heads(self, levels: Level) -> Array:
        return bound_colours(levels)
