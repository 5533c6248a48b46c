"""Colours of motors and thrusters that a level uses."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS, Level, obeying_motors


def bound_colours(levels: Level) -> Array:
    """[W, 6] bool, motor colours first: whether a motor or thruster of the level obeys it."""
    thrusters, obeys = levels.scene.thrusters, obeying_motors(levels)
    motors = jax.nn.one_hot(levels.motor_colour, NUM_MOTOR_COLOURS, dtype=bool) & obeys[..., None]
    thrusts = jax.nn.one_hot(levels.thruster_colour, NUM_THRUSTER_COLOURS, dtype=bool) & thrusters.active[..., None]
    return jnp.concatenate([motors.any(axis=-2), thrusts.any(axis=-2)], axis=-1)
