"""Small cars before a gap or a ramp, with the goal beyond."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.level import WORLD_SIZE_M, Role
from kinetix_dist.level.mechanisms.families.cars import scaled_car
from kinetix_dist.level.mechanisms.registry import family
from kinetix_dist.level.mechanisms.template import (
    CLEARANCE_M,
    WALL_MARGIN_M,
    Draws,
    Joint,
    Mechanism,
    Part,
    Task,
    extent,
    given,
    moved,
)
from kinetix_dist.level.walls import FLOOR_TOP_M


@family("jumper", polygons=4, circles=3, joints=3)
def build_jumper(draws: Draws, capacity: Capacity) -> Mechanism:
    """A small car on a platform, and the goal on another one beyond a gap, at most as high. In two fifths a green bar
    stands on the car, on a motor: it reaches the goal over a wider gap."""
    car = scaled_car(draws, draws.between(0.5, 0.8))
    has_bar, bar_half = draws.chance(0.4), jnp.stack([draws.between(0.03, 0.06), draws.between(0.2, 0.4)])
    chassis = dataclasses.replace(car.parts[0], role=jnp.where(has_bar, Role.NONE, Role.GREEN))
    foot = chassis.position + jnp.stack([jnp.zeros((), jnp.float32), 0.5 * chassis.half_of_box[1]])
    bar = Part(
        position=foot + jnp.stack([jnp.zeros((), jnp.float32), 0.85 * bar_half[1]]),
        half=bar_half,
        role=Role.GREEN,
        active=has_bar,
    )
    lowest, highest = extent(car.parts)
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)
    gap, drop = draws.between(0.1, 0.5), draws.between(0.0, 0.7)
    gap = gap + jnp.where(has_bar, draws.between(0.0, 0.8), 0.0)
    # About the upper edge at the gap of the platform that the car is on.
    width = highest[0] - lowest[0]
    lengths = jnp.stack([width + draws.between(0.2, 1.0), draws.between(0.6, 1.1)])
    thickness = draws.between(0.04, 0.14)  # half of it
    car = dataclasses.replace(
        car, parts=[chassis, *car.parts[1:], bar], joints=[*car.joints, Joint(a=0, b=3, at=foot, active=has_bar)]
    )
    start = draws.between(0.05, 0.15) - lengths[0] - lowest[0]
    car = moved(
        car, jnp.stack([side * start + jnp.where(side > 0.0, 0.0, -(lowest[0] + highest[0])), CLEARANCE_M - lowest[1]])
    )
    platforms = [
        Part(position=jnp.stack([side * x, y - thickness]), half=jnp.stack([0.5 * length, thickness]), is_fixed=True)
        for x, y, length in (
            (-0.5 * lengths[0], jnp.zeros((), jnp.float32), lengths[0]),
            (gap + 0.5 * lengths[1], -drop, lengths[1]),
        )
    ]
    goal_radius = draws.between(0.1, 0.2)
    goal_x = gap + lengths[1] - goal_radius - draws.between(0.0, 0.2)
    left, right = WALL_MARGIN_M + lengths[0], WORLD_SIZE_M - WALL_MARGIN_M - gap - lengths[1]
    x = draws.between(left, right)
    x = jnp.where(side > 0.0, x, WORLD_SIZE_M - x)
    return Mechanism(
        parts=[*car.parts, *platforms],
        joints=car.joints,
        task=Task(
            middle=given(jnp.stack([x, draws.between(FLOOR_TOP_M + 1.1, 3.2)])),
            goal=jnp.stack([side * goal_x, goal_radius + CLEARANCE_M - drop]),
            goal_radius=given(goal_radius),
            colours_in_turn=has_bar & draws.chance(0.8),
            floor_is_red=given(draws.chance(0.7)),
        ),
    )


@family("ramp", polygons=4, circles=3, joints=2)
def build_ramp(draws: Draws, capacity: Capacity) -> Mechanism:
    """A small car on the floor before a steep ramp, a red slab behind it, and the goal beyond: fast enough, it flies
    over. Green is the chassis or the wheel in front."""
    car = scaled_car(draws, draws.between(0.5, 0.75))
    lowest, highest = extent(car.parts)
    wheel_is_green, side = draws.chance(0.4), jnp.where(draws.chance(0.5), 1.0, -1.0)
    front = side > 0.0
    roles = [
        jnp.where(wheel_is_green, Role.NONE, Role.GREEN),
        jnp.where(wheel_is_green & ~front, Role.GREEN, Role.NONE),
        jnp.where(wheel_is_green & front, Role.GREEN, Role.NONE),
    ]
    parts = [dataclasses.replace(part, role=role) for part, role in zip(car.parts, roles, strict=True)]
    # From the end of the car on, all to one side: ramp, slab, goal.
    half, slope = jnp.stack([draws.between(0.15, 0.36), jnp.full((), 0.05, jnp.float32)]), draws.between(0.2, 0.8)
    cos, sin = jnp.cos(slope), jnp.sin(slope)
    ramp_x = draws.between(0.1, 0.7) + half[0] * cos + half[1] * sin
    ramp_y = half[0] * sin - 0.5 * half[1]  # its lower end is in the floor
    red = jnp.stack([draws.between(0.15, 0.4), draws.between(0.02, 0.05)])
    red_x = ramp_x + half[0] * cos + half[1] + red[0]
    radius, is_slab = draws.between(0.12, 0.25), draws.chance(0.5)
    slab = jnp.stack([draws.between(0.12, 0.22), draws.between(0.15, 0.4)])
    goal_half = jnp.where(is_slab, slab, radius)
    goal_x = red_x + red[0] + 0.05 + goal_half[0] + draws.between(0.0, 0.4)
    floor = FLOOR_TOP_M + CLEARANCE_M
    length = goal_x + goal_half[0]
    begin = jnp.where(front, highest[0], -lowest[0])  # from the origin of the car to its end
    width = highest[0] - lowest[0]
    x = WALL_MARGIN_M + width + draws.between(0.0, 1.0) * (WORLD_SIZE_M - 2.0 * WALL_MARGIN_M - width - length)
    middle = jnp.stack([jnp.where(front, x, WORLD_SIZE_M - x) - side * begin, floor - lowest[1]])

    def from_car(x: Array, y: Array) -> Array:
        """[2] m, from the origin of the car: x from its end, y from the floor."""
        return jnp.stack([side * (begin + x), FLOOR_TOP_M + y - middle[1]])

    parts += [
        Part(position=from_car(ramp_x, ramp_y), angle=side * slope, half=half, is_fixed=True),
        Part(position=from_car(red_x, red[1]), half=red, role=Role.RED, is_fixed=True),
    ]
    return Mechanism(
        parts=parts,
        joints=car.joints,
        task=Task(
            middle=given(middle),
            goal=from_car(goal_x, CLEARANCE_M + goal_half[1]),
            goal_radius=given(radius),
            slab=given(slab),
            goal_is_slab=is_slab,
            has_bump=False,
            has_full_motors=draws.chance(0.8),
            floor_is_red=given(jnp.array(False)),
        ),
    )
