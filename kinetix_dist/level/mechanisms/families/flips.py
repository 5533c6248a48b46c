"""Mechanisms with a red and a blue part that have to turn over, so that blue touches green first."""

from __future__ import annotations

import math

import jax.numpy as jnp

from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Role
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
)
from kinetix_dist.level.walls import FLOOR_TOP_M


@family("turner", polygons=1, circles=2, joints=1)
def build_turner(draws: Draws, capacity: Capacity) -> Mechanism:
    """A blue disc and, below it, a red one, in the air and on one motor; green is a slab on the floor. Where there is
    room, half have a blue box instead of the disc. The blue one has to come down first."""
    may_be_box = capacity.polygons - NUM_WALLS >= 2
    radii = [draws.between(0.1, 0.25) for _ in range(2)]
    box = jnp.stack([draws.between(0.08, 0.3), draws.between(0.06, 0.15)])
    is_box = draws.chance(0.5) if may_be_box else jnp.array(False)
    direction = draws.between(0.1, 0.9) * math.pi  # of the blue one, above the red one
    apart = draws.between(0.4, 1.0) * (radii[0] + radii[1]) * jnp.stack([jnp.cos(direction), jnp.sin(direction)])
    at = draws.between(0.0, 1.0) * apart
    blue, red = Role.GREEN, Role.RED  # exchanged with the goal's
    parts = [
        Part(position=jnp.zeros(2, jnp.float32), radius=radii[1], role=red),
        Part(position=apart, radius=radii[0], role=blue, active=~is_box),
    ]
    joints = [Joint(a=0, b=1, at=at, active=~is_box)]
    if may_be_box:
        parts.append(Part(position=apart, angle=direction, half=box, role=blue, active=is_box))
        joints.append(Joint(a=0, b=2, at=at, active=is_box))
    slab = jnp.stack([draws.between(1.2, 2.3), draws.between(0.03, 0.1)])
    middle = jnp.stack([draws.between(0.9, WORLD_SIZE_M - 0.9), draws.between(FLOOR_TOP_M + 1.2, 4.2)])
    slab_x = draws.between(WALL_MARGIN_M + slab[0], WORLD_SIZE_M - WALL_MARGIN_M - slab[0])
    slab_y = FLOOR_TOP_M + CLEARANCE_M + slab[1]
    return Mechanism(
        parts=parts,
        joints=joints,
        task=Task(
            middle=given(middle),
            goal=jnp.stack([slab_x, slab_y]) - middle,
            slab=given(slab),
            goal_is_green=True,
            has_bump=False,
            floor_is_red=given(jnp.array(False)),
            goal_is_slab=True,
        ),
    )


@family("flipper", polygons=2, circles=2, joints=2, thrusters=2)
def build_flipper(draws: Draws, capacity: Capacity) -> Mechanism:
    """A car with a blue wheel and a red one, the red one beside the goal, and two thrusters somewhere on it that push
    up. It has to turn over, so that the blue one comes first; green is a box on the floor."""
    radius = draws.between(0.14, 0.36)
    along = radius + draws.between(0.05, 0.25)
    half = jnp.stack([along, draws.between(0.06, 0.12)])
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)  # of the goal, from the car
    blue, red = Role.GREEN, Role.RED  # exchanged with the goal's
    axles = [jnp.stack([way * side * along, jnp.zeros((), jnp.float32)]) for way in (-1.0, 1.0)]
    parts = [Part(position=jnp.zeros(2, jnp.float32), half=half)]
    parts += [Part(position=axle, radius=radius, role=role) for axle, role in zip(axles, (blue, red), strict=True)]
    mass = 4.0 * half[0] * half[1] + 2.0 * math.pi * radius**2
    power = draws.between(0.65, 2.0) * mass * GRAVITY_M_S2 * NEWTON
    thrusters = [
        Thruster(
            part=0,
            at=half * jnp.stack([draws.between(-0.9, 0.9), jnp.full((), -0.9, jnp.float32)]),
            angle=jnp.asarray(0.5 * math.pi),
            power=power,
            colour=colour,
        )
        for colour in range(2)
    ]
    slab = jnp.stack([draws.between(0.15, 0.35), draws.between(0.2, 0.5)])
    away = along + radius + draws.between(0.1, 1.0) + slab[0]
    reach = along + radius
    x = draws.between(WALL_MARGIN_M + reach, WORLD_SIZE_M - WALL_MARGIN_M - away - slab[0])
    floor = FLOOR_TOP_M + CLEARANCE_M
    middle = jnp.stack([jnp.where(side > 0.0, x, WORLD_SIZE_M - x), floor + radius])
    return Mechanism(
        parts=parts,
        joints=[Joint(a=0, b=1 + k, at=axle) for k, axle in enumerate(axles)],
        thrusters=thrusters,
        task=Task(
            middle=given(middle),
            goal=jnp.stack([side * away, slab[1] - radius]),
            slab=given(slab),
            goal_is_green=True,
            has_bump=False,
            floor_is_red=given(jnp.array(False)),
            goal_is_slab=True,
        ),
    )
