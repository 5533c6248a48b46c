"""Controls from actions: an action belongs to a colour, and every motor or thruster of that colour obeys it.

    actions [W, 6] -> value of each colour [W, 4], [W, 2] -> value of each motor [W, J] and thruster [W, T]

Joints with `motor_auto` run forward whatever the action. Numbers outside of the space act as "off" and are
counted, never clamped: a policy that emits them shows in `StepInfo.invalid_actions`.
"""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array, Controls
from kinetix_dist.env.action_spaces import ActionSpace


def controls_of(
    space: ActionSpace, actions: Array, motor_colour: Array, motor_auto: Array, thruster_colour: Array
) -> tuple[Controls, Array]:
    """Controls of a batch of worlds and the number of actions out of range, [W] int32.

    actions [W, 6] or [W] (see action_spaces/), motor_colour and motor_auto [W, J], thruster_colour [W, T].
    """
    allowed = space.in_range(actions)
    colour_motor, colour_thruster = space.colour_values(actions, allowed)
    motor = jnp.take_along_axis(colour_motor, motor_colour, axis=1)
    motor = jnp.where(motor_auto, 1.0, motor)
    thruster = jnp.take_along_axis(colour_thruster, thruster_colour, axis=1)
    num_invalid = (~allowed).reshape(allowed.shape[0], -1).sum(axis=1, dtype=jnp.int32)
    return Controls(motor=motor, thruster=thruster), num_invalid
