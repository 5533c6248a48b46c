"""Flippers of a pinball machine."""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.level import WORLD_SIZE_M, Role
from kinetix_dist.level.mechanisms.registry import family
from kinetix_dist.level.mechanisms.template import WALL_MARGIN_M, Draws, Joint, Mechanism, Part, Task, given
from kinetix_dist.level.walls import FLOOR_TOP_M


@family("pinball", polygons=4, circles=4, joints=2)
def build_pinball(draws: Draws, capacity: Capacity) -> Mechanism:
    """Two flippers that guides from the walls lead to, a green disc that falls onto one of them or beside it, and up to
    two fixed discs in its way. The goal is at the side of the other one, above it or its guide."""
    gap, length, width = draws.between(0.08, 0.3), draws.between(0.8, 1.4), draws.between(0.05, 0.09)
    slope, side = draws.between(0.3, 0.8), jnp.where(draws.chance(0.5), 1.0, -1.0)
    run = 0.5 * WORLD_SIZE_M - gap - length  # of a guide, level
    limit = draws.between(0.5, 0.9)
    parts, joints = [], []
    for number, way in enumerate((-1.0, 1.0)):
        pivot = jnp.stack([way * (gap + length), jnp.zeros((), jnp.float32)])
        rise = 0.5 * run * jnp.tan(slope)
        parts.append(
            Part(
                position=pivot + jnp.stack([0.5 * way * run, rise]),
                angle=way * slope,
                half=jnp.stack([0.5 * run / jnp.cos(slope), width]),
                is_fixed=True,
            )
        )
        parts.append(
            Part(
                position=pivot - jnp.stack([0.5 * way * length, jnp.zeros((), jnp.float32)]),
                half=jnp.stack([0.5 * length + 0.5 * width, width]),
            )
        )
        joints.append(Joint(a=2 * number, b=2 * number + 1, at=pivot, limit=given(limit)))
    ball, radius, y = draws.between(0.1, 0.18), draws.between(0.15, 0.35), FLOOR_TOP_M + draws.between(0.7, 1.4)
    ceiling = WORLD_SIZE_M - WALL_MARGIN_M - y

    def lowest(x: Array, disc: Array) -> Array:
        """The y at which a disc of that radius touches a flipper or, beyond its pivot, the guide."""
        return (width + disc) / jnp.cos(slope) + jnp.maximum(x - gap - length, 0.0) * jnp.tan(slope)

    ball_x = draws.between(0.62, 1.3)
    ball_y = draws.between(lowest(ball_x, ball) + 0.05, 2.0)
    parts.append(Part(position=jnp.stack([-side * ball_x, ball_y]), radius=ball, role=Role.GREEN))
    goal_x = draws.between(0.8, 1.9)
    # One in the middle and one beside the wall, where the disc does not begin.
    for low, high, largest in ((-0.08, 0.08, 0.35), (1.75, 2.1, 0.22)):
        at = jnp.stack([-side * draws.between(low, high), draws.between(1.0, ceiling - 0.4)])
        parts.append(Part(position=at, radius=draws.between(0.1, largest), is_fixed=True, active=draws.chance(0.6)))
    return Mechanism(
        parts=parts,
        joints=joints,
        task=Task(
            middle=given(jnp.stack([jnp.full((), 0.5 * WORLD_SIZE_M, jnp.float32), y])),
            goal=jnp.stack([side * goal_x, draws.between(jnp.maximum(0.9, lowest(goal_x, radius)), ceiling - radius)]),
            goal_radius=given(radius),
            colours_in_turn=draws.chance(0.6),
            floor_is_red=given(draws.chance(0.7)),
        ),
    )
