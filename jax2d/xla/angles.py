"""Angles that stay within half a turn, so that what turns for hours loses no digits."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.constants import CONSTANTS as C
from jax2d.scene import JointKind, Joints
from jax2d.solver_numbers import Scalar


def near(angle: jax.Array, middle: Scalar) -> jax.Array:
    """The same direction within half a turn of another angle. As it is where it is so already."""
    away = angle - middle
    turns = jnp.round(away / (C.turn_high + C.turn_low))
    return jnp.where(jnp.abs(away) > C.half_turn, (angle - turns * C.turn_high) - turns * C.turn_low, angle)


def has_wide_limits(joints: Joints) -> jax.Array:
    """[J] bool, active joints whose limits say how often a body has turned against the other."""
    is_wide = joints.upper_limit - joints.lower_limit > C.wide_limits
    return joints.active & joints.has_limits & joints.is_kind(JointKind.REVOLUTE) & is_wide


def counts_turns(joints: Joints, num_shapes: int) -> jax.Array:
    """[n] bool, shapes whose angle is not wrapped: those of joints with wide limits."""
    ends = jnp.stack([joints.a, joints.b], -1)[..., None] == jnp.arange(num_shapes)
    return jnp.any(ends & has_wide_limits(joints)[:, None, None], axis=(0, 1))


def wanted(angle: jax.Array, joints: Joints) -> jax.Array:
    """Joint angles [J], known up to full turns, at their values nearest to where the joints want them."""
    is_bounded = joints.has_limits & joints.is_kind(JointKind.REVOLUTE)
    middle = jnp.where(is_bounded, 0.5 * (joints.lower_limit + joints.upper_limit), 0)
    return jnp.where(has_wide_limits(joints), angle, near(angle, middle))
