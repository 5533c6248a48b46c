"""Arms with a hand of two fingers, and a box to carry to the floor."""

from __future__ import annotations

import functools
import math

import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.level import WORLD_SIZE_M, Role
from kinetix_dist.level.mechanisms.registry import family
from kinetix_dist.level.mechanisms.template import (
    CLEARANCE_M,
    WALL_MARGIN_M,
    Draws,
    Joint,
    Mechanism,
    Part,
    Task,
    given,
)
from kinetix_dist.level.walls import FLOOR_TOP_M


@family("grasper", polygons=7, circles=1, joints=5)
def build_grasper(draws: Draws, capacity: Capacity) -> Mechanism:
    """An arm of two links on a fixed disc, and a hand of two fingers; on the lower one lies a green box that nothing
    holds. The goal is a slab on the floor, mostly behind the arm."""
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)
    upper, fore, finger = draws.between(0.5, 0.8), draws.between(0.4, 0.7), draws.between(0.25, 0.4)
    width, palm = draws.between(0.03, 0.05), draws.between(0.16, 0.22)
    lean, lower_rise, upper_rise = draws.between(-0.3, 0.3), draws.between(0.0, 0.12), draws.between(0.0, 0.5)
    size, along = draws.between(0.05, 0.075), draws.between(0.35, 0.8)

    def mirrored(x: Array, y: Array) -> Array:
        return jnp.stack([side * x, y])

    link = functools.partial(_link_to, side)
    zero = jnp.zeros((), jnp.float32)
    upper_arm, elbow = link(jnp.zeros(2, jnp.float32), lean - 0.5 * math.pi, upper, width)
    forearm, wrist = link(elbow, zero, fore, width)
    knuckles = [wrist + jnp.stack([zero, end * palm]) for end in (-1.0, 1.0)]
    fingers = [
        link(knuckle, rise, finger, 0.03)[0] for knuckle, rise in zip(knuckles, (lower_rise, upper_rise), strict=True)
    ]
    on = mirrored(jnp.cos(lower_rise), jnp.sin(lower_rise)), mirrored(-jnp.sin(lower_rise), jnp.cos(lower_rise))
    load = knuckles[0] + (along * (finger - size) + size) * on[0] + (0.03 + size + CLEARANCE_M) * on[1]
    parts = [
        Part(position=jnp.zeros(2, jnp.float32), radius=draws.between(0.08, 0.14), is_fixed=True),
        upper_arm,
        forearm,
        Part(position=wrist, half=jnp.stack([jnp.full((), 0.03, jnp.float32), palm])),
        *fingers,
        Part(position=load, angle=side * lower_rise, half=jnp.stack([size, size]), role=Role.GREEN),
    ]
    limit = jnp.full((), 0.8, jnp.float32)
    joints = [
        Joint(a=0, b=1, at=jnp.zeros(2, jnp.float32)),
        Joint(a=1, b=2, at=elbow),
        Joint(a=2, b=3, at=wrist, is_weld=True),
        *(Joint(a=3, b=4 + number, at=knuckle, limit=given(limit)) for number, knuckle in enumerate(knuckles)),
    ]
    slab = jnp.stack([draws.between(0.15, 0.4), draws.between(0.03, 0.08)])
    middle = jnp.stack([draws.between(1.7, WORLD_SIZE_M - 1.7), FLOOR_TOP_M + upper + draws.between(0.45, 1.2)])
    goal = jnp.stack([middle[0] + side * draws.between(-1.2, 0.3), FLOOR_TOP_M + CLEARANCE_M + slab[1]])
    return Mechanism(
        parts=parts,
        joints=joints,
        task=Task(
            middle=given(middle),
            goal=goal - middle,
            slab=given(slab),
            has_bump=False,
            floor_is_red=given(draws.chance(0.5)),
            goal_is_slab=True,
        ),
    )


@family("gripper", polygons=8, circles=3, joints=6)
def build_gripper(draws: Draws, capacity: Capacity) -> Mechanism:
    """An arm of two links on a fixed disc, and an open hand of two fingers of two links that close towards each other.
    A green box falls between them, or stands on a disc on the floor; the goal is on the floor."""
    side = jnp.where(draws.chance(0.5), 1.0, -1.0)
    upper, fore, palm, tip = (draws.between(*ends) for ends in ((0.55, 1.0), (0.5, 1.0), (0.2, 0.36), (0.2, 0.36)))
    width, finger_width = draws.between(0.04, 0.09), draws.between(0.03, 0.06)
    lean, spread, size = draws.between(-0.2, 0.2), draws.between(0.2, 0.9), draws.between(0.06, 0.12)
    falls, pedestal = draws.chance(0.5), draws.between(0.12, 0.22)
    limit = draws.between(0.4, 0.6)

    link = functools.partial(_link_to, side)
    upper_arm, elbow = link(jnp.zeros(2, jnp.float32), lean - 0.5 * math.pi, upper, width, beyond=0.5 * width)
    forearm, wrist = link(elbow, jnp.zeros((), jnp.float32), fore, width, beyond=0.5 * width)
    fingers, joints = (
        [],
        [Joint(a=0, b=1, at=jnp.zeros(2, jnp.float32), turn=given(0)), Joint(a=1, b=2, at=elbow, turn=given(1))],
    )
    for number, way in enumerate((1.0, -1.0)):  # the upper one, the lower one
        knuckle = wrist + jnp.stack([jnp.zeros((), jnp.float32), way * 0.3 * palm])
        inner, joint = link(knuckle, jnp.asarray(way * 0.5 * math.pi), palm, finger_width, beyond=0.5 * finger_width)
        outer, _ = link(joint, way * spread, tip, finger_width, beyond=0.5 * finger_width)
        fingers += [inner, outer]
        closing, first = -way * side * limit, 3 + 2 * number
        joints += [
            Joint(a=of, b=first + index, at=at, limit=given(limit), bend=closing, turn=given(2 + number))
            for index, (of, at) in enumerate(((2, knuckle), (first, joint)))
        ]
    reach = upper * jnp.cos(lean) + 1.3 * palm + tip  # below the disc, at most
    above = jnp.where(falls, 0.1, 2.0 * (pedestal + size) + 0.1)
    y = FLOOR_TOP_M + reach + above + draws.between(0.0, 0.4)
    room = fore + jnp.abs(jnp.sin(lean)) * upper + tip + 2.0 * size + 0.3
    x = draws.between(room, WORLD_SIZE_M - 0.9)
    middle = jnp.stack([jnp.where(side < 0.0, x, WORLD_SIZE_M - x), y])
    inside = finger_width + size + draws.between(0.03, 0.15)
    within = wrist + jnp.stack([side * inside, draws.between(-0.2, 0.6) * palm])
    disc_x = wrist[0] + side * draws.between(-0.4, 0.25)
    on_disc = jnp.stack([disc_x, FLOOR_TOP_M + 2.0 * pedestal + size + CLEARANCE_M - y])
    parts = [
        Part(position=jnp.zeros(2, jnp.float32), radius=draws.between(0.1, 0.25), is_fixed=True),
        upper_arm,
        forearm,
        *fingers,
        Part(position=jnp.where(falls, within, on_disc), half=jnp.stack([size, size]), role=Role.GREEN),
        Part(position=jnp.stack([disc_x, FLOOR_TOP_M + pedestal - y]), radius=pedestal, is_fixed=True, active=~falls),
    ]
    slab = jnp.stack([draws.between(0.2, 0.45), draws.between(0.03, 0.14)])
    # On the floor of the other side, or nearer, but not where a box that is knocked off its disc falls, where there is
    # room.
    goal_x = middle[0] - side * draws.between(-0.1, 1.2)
    clear = middle[0] + disc_x - side * (pedestal + slab[0] + draws.between(0.4, 0.8))
    goal_x = jnp.where(falls, goal_x, side * jnp.minimum(side * goal_x, side * clear))
    goal_x = jnp.clip(goal_x, WALL_MARGIN_M + slab[0], WORLD_SIZE_M - WALL_MARGIN_M - slab[0])
    return Mechanism(
        parts=parts,
        joints=joints,
        task=Task(
            middle=given(middle),
            goal=jnp.stack([goal_x, FLOOR_TOP_M + CLEARANCE_M + slab[1]]) - middle,
            slab=given(slab),
            has_bump=False,
            colours_in_turn=True,
            floor_is_red=given(draws.chance(0.5)),
            goal_is_slab=True,
        ),
    )


def _link_to(
    side: Array, start: Array, angle: Array, length: Array, half_width: Array | float, beyond: Array | float = 0.0
) -> tuple[Part, Array]:
    """A box of so much length ([] m) from `start` ([2] m) on, reaching beyond both ends, and its end.

    angle: rad, as where `side` is 1; where it is -1 left and right are exchanged.
    """
    way = jnp.stack([side * jnp.cos(angle), jnp.sin(angle)])
    half = jnp.stack([0.5 * length + beyond, jnp.asarray(half_width)])
    return Part(position=start + 0.5 * length * way, angle=side * angle, half=half), start + length * way
