"""The details of the published package (jax2d 1.0.2) that the paper does not prescribe, for comparison with it.

Each acts only where `Settings.published_details` names it; the names and what they mean are in
jax2d/published_details.py. The order in which contacts are solved is in published_order.py.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Capacity
from jax2d.solver_numbers import Scalar
from jax2d.xla import vec2
from jax2d.xla.bodies import Bodies, Velocities, pair_mass, pick

if TYPE_CHECKING:
    from jax2d.xla.contact_solver import Row
    from jax2d.xla.pairs import PairList

REFERENCE_BIAS_M = 0.01
FIXED_SLOTS = 4  # polygons meant for floor, walls and ceiling
CLIP_POSITION_M = 15.0


def centre_inside(
    normal: jax.Array, separation: jax.Array, face_distance: jax.Array, radius: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Normal [2] and separation [] of a circle's centre that is inside a polygon or on its edge."""
    return jnp.where(face_distance == 0, 0, normal), jnp.where(face_distance < 0, -radius, separation)


def clip_and_keep_depth(ends: jax.Array, n: jax.Array, face_length: jax.Array) -> jax.Array:
    """Ends [2, 2] of the incident edge, relative to the start of the reference face, moved over it."""
    along = vec2.left(n)
    u = jnp.clip(vec2.dot(ends, along), 0, face_length)
    return u[:, None] * along + vec2.dot(ends, n)[:, None] * n


def is_fixed_pair(pairs: PairList, capacity: Capacity) -> np.ndarray:
    """[points] bool: both shapes are polygons in slots meant for floor and walls."""
    return pairs.point_b < min(FIXED_SLOTS, capacity.polygons)


def move_and_clip(bodies: Bodies, dt: Scalar, max_speed: Scalar, max_omega: Scalar) -> Bodies:
    """Semi-implicit Euler, then every coordinate is clipped. What is clipped is counted."""
    velocity, omega = bodies.velocities
    dynamic = bodies.is_dynamic
    delta = bodies.delta + jnp.where(dynamic[:, None], velocity * dt, 0)
    outside = jnp.abs(bodies.position + delta) > CLIP_POSITION_M
    to_border = jnp.sign(bodies.position + delta) * CLIP_POSITION_M - bodies.position
    velocities = Velocities(jnp.clip(velocity, -max_speed, max_speed), jnp.clip(omega, -max_omega, max_omega))
    acted = jnp.any(outside | (velocities.velocity != velocity), axis=-1) | (velocities.omega != omega)
    return bodies._replace(
        velocities=velocities,
        delta=jnp.where(outside, to_border, delta),
        turn=bodies.turn + jnp.where(dynamic, omega * dt, 0),
        limited=bodies.limited + jnp.sum(acted & dynamic, dtype=jnp.int32),
    )


def arms_from_here(bodies: Bodies, rows: Row) -> Row:
    """Arms lead to the same points from where the positional correction of joints has moved the bodies."""
    pair = rows.pair
    arm_a, arm_b = rows.arm_a - pick(pair.is_a, bodies.delta), rows.arm_b - pick(pair.is_b, bodies.delta)
    return rows._replace(
        arm_a=arm_a,
        arm_b=arm_b,
        mass_normal=pair_mass(pair, arm_a, arm_b, rows.normal),
        mass_tangent=pair_mass(pair, arm_a, arm_b, vec2.right(rows.normal)),
    )
