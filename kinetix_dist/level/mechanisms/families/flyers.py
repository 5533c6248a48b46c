"""Mechanisms in the air that thrusters carry."""

from __future__ import annotations

import math

import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Role
from kinetix_dist.level.mechanisms.links import Body, Link, add_link
from kinetix_dist.level.mechanisms.registry import family
from kinetix_dist.level.mechanisms.template import (
    CLEARANCE_M,
    GRAVITY_M_S2,
    NEWTON,
    WALL_MARGIN_M,
    Draws,
    Joint,
    Mechanism,
    Part,
    Task,
    Thruster,
    given,
    mirrored_thrusters,
)
from kinetix_dist.level.walls import FLOOR_TOP_M

MAX_BLOCKS = 3  # in the way of a flyer
MAX_BARS = 3  # over a climber
ROPE_LINKS = 3  # that a lander hangs its load on


@family("flyer", polygons=1, circles=1, thrusters=2)
def build_flyer(draws: Draws, capacity: Capacity) -> Mechanism:
    """A green box or disc with two thrusters that carry it, in the air, and a gap or blocks on the way. The
    thrusters push up and to the side, or both tilted."""
    parts, thrusters, half = _flying(draws, capacity)
    return Mechanism(
        parts=parts,
        thrusters=thrusters,
        num_blocks=MAX_BLOCKS,
        task=Task(
            is_handed=True,
            height=draws.between(0.6, 2.6),
            goal_height=given(draws.between(0.8, 4.6)),
            has_bump=False,
            gap=given(jnp.max(half) + draws.between(0.25, 0.8)),
            floor_is_red=given(draws.chance(0.6)),
        ),
    )


def _flying(draws: Draws, capacity: Capacity) -> tuple[list[Part], list[Thruster], Array]:
    """A green box and, where there is room, a green disc, one of them active; its two thrusters, and its half
    extents ([2] m)."""
    is_disc = draws.chance(0.5) if capacity.circles >= 2 else jnp.array(False)
    box = jnp.stack([draws.between(0.13, 0.25), draws.between(0.09, 0.18)])
    radius = draws.between(0.13, 0.27)
    half = jnp.where(is_disc, radius, box)
    weight = jnp.where(is_disc, math.pi * radius**2, 4.0 * box[0] * box[1]) * GRAVITY_M_S2
    is_pair = draws.chance(0.6)
    # Of the weight, by all that push up; in some levels it only just rises.
    lift = jnp.where(draws.chance(0.3), draws.between(1.02, 1.2), draws.between(1.2, 2.2))
    sideways = draws.between(0.25, 1.0)  # of the lift, where one pushes to the side
    tilt = draws.between(0.15, 0.5)
    thrusters = []
    for colour, side in enumerate((-1.0, 1.0)):
        power = weight * NEWTON * lift * jnp.where(is_pair, 0.6, 1.0 if colour == 0 else sideways)
        angle = jnp.where(is_pair, 0.5 * math.pi + tilt * side, 0.5 * math.pi if colour == 0 else 0.0)
        behind = half * jnp.array([0.0, -1.0] if colour == 0 else [-1.0, 0.0], jnp.float32)
        at = jnp.where(is_pair, half * jnp.array([0.7 * side, 0.0], jnp.float32), behind)
        thrusters.append(Thruster(part=is_disc.astype(jnp.int32), at=at, angle=angle, power=power, colour=colour))
    discs = [Part(position=jnp.zeros(2, jnp.float32), radius=radius, role=Role.GREEN, active=is_disc)]
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=box, role=Role.GREEN, active=~is_disc)]
    return parts + (discs if capacity.circles >= 2 else []), thrusters, half


@family("climber", polygons=4, circles=2, thrusters=2)
def build_climber(draws: Draws, capacity: Capacity) -> Mechanism:
    """A flyer below one bar or up to three that reach over it from the wall on its side, mostly red. The goal is
    above them at the other side. In a quarter there is a shelf below the goal instead, mostly not red."""
    parts, thrusters, half = _flying(draws, capacity)
    size = jnp.max(half)
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)  # of the goal

    def in_world(x: Array, y: Array) -> Array:
        """[2] m, x from the wall on its side."""
        return jnp.stack([jnp.where(side > 0.0, x, WORLD_SIZE_M - x), y])

    start_x, start_y = draws.between(0.5, 1.5), FLOOR_TOP_M + size + draws.between(0.2, 0.8)
    number, thickness = draws.number(1, MAX_BARS), draws.between(0.05, 0.12)  # half of it
    apart = 2.0 * (size + thickness) + draws.between(0.2, 0.5)  # from one bar to the next
    y = start_y + size + thickness + draws.between(0.15, 0.5)
    radius = draws.between(0.12, 0.28)
    above = thickness + 2.0 * jnp.maximum(radius, size) + WALL_MARGIN_M  # from the last bar to the ceiling, at least
    number = jnp.minimum(number, 1 + jnp.floor((WORLD_SIZE_M - above - y) / apart).astype(jnp.int32))
    goal_x = draws.between(0.6 * WORLD_SIZE_M, WORLD_SIZE_M - WALL_MARGIN_M - radius)
    is_shelf, shelf_reach = draws.chance(0.25), radius + draws.between(0.0, 0.6)  # to both sides of the goal
    # It passes on both sides.
    shelf_x = jnp.minimum(goal_x, WORLD_SIZE_M - 2.0 * size - WALL_MARGIN_M - shelf_reach)
    number = jnp.where(is_shelf, 1, number)
    middle, bars = in_world(start_x, start_y), []
    for bar in range(MAX_BARS):
        beyond = start_x + size * draws.between(0.0, 1.0)  # it covers half of the flyer at least
        begin, end = draws.between(0.02, 0.4), draws.between(beyond, WORLD_SIZE_M - 2.0 * size - 0.8)
        begin = jnp.where(is_shelf, shelf_x - shelf_reach, begin)
        end = jnp.where(is_shelf, shelf_x + shelf_reach, end)
        role = jnp.where(draws.chance(0.75) ^ is_shelf, Role.RED, Role.NONE)
        at, bar_half = in_world(0.5 * (begin + end), y + bar * apart), jnp.stack([0.5 * (end - begin), thickness])
        bars.append(Part(position=at - middle, half=bar_half, role=role, is_fixed=True, active=bar < number))
    lowest = y + (number - 1) * apart + thickness + radius + CLEARANCE_M
    goal_y = draws.between(lowest, WORLD_SIZE_M - CLEARANCE_M - radius)
    goal_x = jnp.where(
        is_shelf, jnp.clip(goal_x, shelf_x - shelf_reach + radius, shelf_x + shelf_reach - radius), goal_x
    )
    return Mechanism(
        parts=[*parts, *bars],
        thrusters=[mirrored_thrusters(thruster, side < 0.0) for thruster in thrusters],
        task=Task(
            middle=given(middle),
            goal=in_world(goal_x, goal_y) - middle,
            goal_radius=given(radius),
            floor_is_red=given(draws.chance(0.6)),
        ),
    )


@family("lander", polygons=2, circles=0, thrusters=2)
def build_lander(draws: Draws, capacity: Capacity) -> Mechanism:
    """A green box with two thrusters at its lower corners, in the air; the goal is a slab on the floor.

    Where there is room, two fifths carry a green disc on a rope of links instead, and half of the others have two legs.
    """
    rope_fits = capacity.joints > ROPE_LINKS and capacity.polygons - NUM_WALLS >= ROPE_LINKS + 4
    has_rope = draws.chance(0.4) if rope_fits else jnp.array(False)
    half = jnp.stack([draws.between(0.11, 0.22), draws.between(0.1, 0.18)])
    half = half * jnp.where(has_rope, draws.between(1.0, 1.8), 1.0)
    role = jnp.where(has_rope, Role.NONE, Role.GREEN)
    body = Body(parts=[Part(position=jnp.zeros(2, jnp.float32), half=half, role=role)])
    mass = 4.0 * half[0] * half[1]
    if rope_fits:
        has_legs = draws.chance(0.5) & ~has_rope
        leg, splay = jnp.stack([draws.between(0.02, 0.03), draws.between(0.05, 0.09)]), draws.between(0.3, 0.9)
        link = jnp.stack([draws.between(0.03, 0.045), draws.between(0.08, 0.15)])
        # Feet end above the lower side of the box: green must touch blue.
        hip_y = 1.9 * leg[1] * jnp.cos(splay) + leg[0] * jnp.sin(splay) - half[1]
        for side in (-1.0, 1.0):
            hip = jnp.stack([side * 0.9 * half[0], hip_y])
            foot = Link(half=leg, active=has_legs, lean=side * splay, motion="welded")
            add_link(draws, body, foot, of=0, at=hip)
        at = jnp.stack([jnp.zeros((), jnp.float32), -0.9 * half[1]])
        rope = Link(half=link, active=has_rope, lean=jnp.zeros((), jnp.float32), motion="free")
        for number in range(ROPE_LINKS):
            at = add_link(draws, body, rope, of=body.last if number else 0, at=at)
        radius = draws.between(0.1, 0.18)
        load = Part(
            position=at - jnp.stack([jnp.zeros((), jnp.float32), 0.8 * radius]),
            radius=radius,
            role=Role.GREEN,
            active=has_rope,
        )
        body.joints.append(Joint(a=body.last, b=body.last + 1, at=at, has_motor=False, active=has_rope))
        body.parts.append(load)
        mass = mass + jnp.where(has_legs, 2.0 * 4.0 * leg[0] * leg[1], 0.0)
        mass = mass + jnp.where(has_rope, ROPE_LINKS * 4.0 * link[0] * link[1] + math.pi * radius**2, 0.0)
    lift, tilt = draws.between(1.1, 2.6), draws.between(0.0, 0.5)
    power = 0.5 * lift * mass * GRAVITY_M_S2 * NEWTON / jnp.cos(tilt)
    thrusters = [
        Thruster(
            part=0,
            at=half * jnp.array([0.9 * side, -0.9], jnp.float32),
            angle=0.5 * math.pi + tilt * side,
            power=power,
            colour=colour,
        )
        for colour, side in enumerate((-1.0, 1.0))
    ]
    return Mechanism(
        parts=body.parts,
        joints=body.joints,
        thrusters=thrusters,
        task=Task(
            height=draws.between(0.9, 2.6),
            slab=given(jnp.stack([draws.between(0.2, 0.6), draws.between(0.03, 0.1)])),
            has_bump=False,
            floor_is_red=given(draws.chance(0.8)),
            goal_is_slab=True,
        ),
    )
