"""Servos: motors that move to a position between the limits of their joint."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.solver_numbers import Scalar
from jax2d.xla import vec2


class Servo(NamedTuple):
    """Target and speed of servos."""

    position: jax.Array  # [J] rad or m, that it moves to
    max_speed: jax.Array  # [J] rad/s or m/s


def servo_of(control: jax.Array, speed: jax.Array, lower: jax.Array, upper: jax.Array) -> Servo:
    """`speed`: at control 1, [J] rad/s or m/s."""
    middle, reach = 0.5 * (lower + upper), 0.5 * (upper - lower)
    return Servo(
        position=middle + jnp.where(speed < 0, -control, control) * reach,
        max_speed=jnp.abs(speed),
    )


def speed_towards(servo: Servo, way: jax.Array, strength: jax.Array, h: Scalar) -> jax.Array:
    """Speed to have for the next h seconds, [J]: the largest from which, losing deceleration x h in each, a servo
    stands still where it is to be. At the end that is the whole way within h. `strength`: rad/s^2 or m/s^2 that the
    motor gives the joint with all that is held."""
    deceleration = C.servo_braking_share * strength
    distance, lost = jnp.abs(way), 0.5 * deceleration * h
    braking = vec2.sqrt_or_zero(lost * lost + 2 * deceleration * distance) - lost
    return jnp.sign(way) * jnp.minimum(servo.max_speed, jnp.minimum(braking, distance / h))
