"""From actions to controls: an action belongs to a colour, and every motor or thruster of that colour obeys it.

    actions [W, 6] -> value of each colour [W, 4], [W, 2] -> value of each motor [W, J] and thruster [W, T]

Joints with `motor_auto` run forward whatever the action. Numbers outside of the space act as "off" and are
counted, never clamped: a policy that emits them shows in `StepInfo.invalid_actions`.
"""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array, Controls
from kinetix_dist.env.spaces import ActionSpace
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_THRUSTER_COLOURS

# Index of the discrete action that moves nothing: 2 x 4 motor directions come before it.
DISCRETE_NOOP = 2 * NUM_MOTOR_COLOURS


def controls_of(
    space: ActionSpace, actions: Array, motor_colour: Array, motor_auto: Array, thruster_colour: Array
) -> tuple[Controls, Array]:
    """Controls of a batch of worlds and the number of actions out of range, [W] int32.

    actions [W, 6] or [W] (see spaces.py), motor_colour and motor_auto [W, J], thruster_colour [W, T].
    """
    allowed = space.in_range(actions)
    colour_motor, colour_thruster = colour_values(space, actions, allowed)
    motor = jnp.take_along_axis(colour_motor, motor_colour, axis=1)
    motor = jnp.where(motor_auto, 1.0, motor)
    thruster = jnp.take_along_axis(colour_thruster, thruster_colour, axis=1)
    num_invalid = (~allowed).reshape(allowed.shape[0], -1).sum(axis=1, dtype=jnp.int32)
    return Controls(motor=motor, thruster=thruster), num_invalid


def colour_values(space: ActionSpace, actions: Array, allowed: Array) -> tuple[Array, Array]:
    """What each colour is told: motors [W, 4] in -1..1, thrusters [W, 2] in 0..1."""
    if space.is_flat:
        choice = jnp.where(allowed, actions, DISCRETE_NOOP)[:, None]
        colours = jnp.arange(NUM_MOTOR_COLOURS)
        motor = (choice == colours).astype(jnp.float32) - (choice == colours + NUM_MOTOR_COLOURS)
        thruster = choice == jnp.arange(NUM_THRUSTER_COLOURS) + DISCRETE_NOOP + 1
        return motor, thruster.astype(jnp.float32)
    actions = jnp.where(allowed, actions, 0)
    motor, thruster = actions[:, :NUM_MOTOR_COLOURS], actions[:, NUM_MOTOR_COLOURS:]
    if space.is_integer:
        # 0 off, 1 forward, 2 backward
        motor = (motor == 1).astype(jnp.float32) - (motor == 2)
    return motor.astype(jnp.float32), thruster.astype(jnp.float32)


def noop_actions(space: ActionSpace, num_worlds: int) -> Array:
    """Actions that drive nothing (but `motor_auto` joints), [W, 6] or [W]."""
    return jnp.full(space.shape(num_worlds), DISCRETE_NOOP if space.is_flat else 0, space.dtype)
