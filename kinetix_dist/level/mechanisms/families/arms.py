"""Arms on a fixed disc: with the goal in reach of their last link, or with a disc to throw."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Role
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

MAX_LINKS = 4  # of an arm


@family("arm", polygons=1, circles=2, joints=1)
def build_arm(draws: Draws, capacity: Capacity) -> Mechanism:
    """Links on a fixed disc, all to one side of it; the goal is to the other side, within reach."""
    num_links = min(capacity.polygons - NUM_WALLS, capacity.joints, MAX_LINKS)
    count = draws.number(min(2, num_links), num_links)
    reach = draws.between(0.8, 1.4)
    towards = -0.5 * math.pi + draws.between(-1.0, 1.0)  # hangs, so that few fall onto their goal
    parts, joints = _links_on_a_disc(draws, num_links, count, reach, towards)
    behind = _behind_the_links(draws, towards)
    goal = jnp.maximum(0.6, draws.between(0.5, 0.9) * reach) * behind
    middle = jnp.stack([draws.between(1.8, WORLD_SIZE_M - 1.8), draws.between(FLOOR_TOP_M + 1.7, 3.2)])
    return Mechanism(parts=parts, joints=joints, task=Task(middle=given(middle), goal=goal))


@family("reacher", polygons=2, circles=2, joints=2)
def build_reacher(draws: Draws, capacity: Capacity) -> Mechanism:
    """A longer arm, whose goal is half of the time where it must be about straight. In two fifths the last link is blue
    and the goal green, and in half of these the first link is red."""
    num_links = min(capacity.polygons - NUM_WALLS, capacity.joints, MAX_LINKS)
    count = draws.number(2, num_links)
    reach = draws.between(0.8, 1.8)
    towards = -0.5 * math.pi + draws.between(-1.0, 1.0)
    goal_is_green = draws.chance(0.4)
    first_is_red = goal_is_green & draws.chance(0.5)
    parts, joints = _links_on_a_disc(draws, num_links, count, reach, towards)
    parts[1] = dataclasses.replace(parts[1], role=jnp.where(first_is_red, Role.RED, parts[1].role))
    share = jnp.where(draws.chance(0.5), draws.between(0.85, 1.0), draws.between(0.4, 0.85))
    goal = jnp.maximum(0.6, share * reach) * _behind_the_links(draws, towards)
    room = reach + 0.3  # from the middle to the walls: for the links, and for the goal at its largest
    x = draws.between(room, WORLD_SIZE_M - room)
    y = draws.between(FLOOR_TOP_M + room, jnp.minimum(3.2, WORLD_SIZE_M - room))
    return Mechanism(
        parts=parts, joints=joints, task=Task(middle=given(jnp.stack([x, y])), goal=goal, goal_is_green=goal_is_green)
    )


def _links_on_a_disc(
    draws: Draws, num_links: int, count: Array, reach: Array, towards: Array
) -> tuple[list[Part], list[Joint]]:
    """The fixed disc and `count` links within 0.6 rad of one direction (rad), the last one green."""
    parts = [Part(position=jnp.zeros(2, jnp.float32), radius=draws.between(0.1, 0.18), is_fixed=True)]
    joints, at = [], jnp.zeros(2, jnp.float32)
    length = reach / count
    width = draws.between(0.04, 0.08)
    for link in range(num_links):
        angle = towards + draws.between(-0.6, 0.6)
        along = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        active = link < count
        role = jnp.where(link == count - 1, Role.GREEN, Role.NONE)
        half = jnp.stack([0.5 * length + 0.5 * width, width])
        parts.append(Part(position=at + 0.5 * length * along, angle=angle, half=half, role=role, active=active))
        joints.append(Joint(a=link, b=link + 1, at=at, active=active))
        at = at + length * along
    return parts, joints


def _behind_the_links(draws: Draws, towards: Array) -> Array:
    """[2] a direction. Links stay within 0.6 rad of `towards`; directions beyond 1.9 rad from it are behind them
    all."""
    angle = towards + math.pi + draws.between(-1.0, 1.0)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


@family("thrower", polygons=1, circles=3, joints=1)
def build_thrower(draws: Draws, capacity: Capacity) -> Mechanism:
    """An arm that turns about a fixed disc, and a green disc that nothing holds: on the far end of a level arm, which
    throws it over the pivot, or on the tip of an upright one; in two fifths it falls onto it first. The goal is some
    way off."""
    half = jnp.stack([draws.between(0.3, 0.6), draws.between(0.03, 0.06)])
    ball, pivot, goal_radius = draws.between(0.08, 0.16), draws.between(0.06, 0.1), draws.between(0.12, 0.55)
    is_upright, side = draws.chance(0.3), jnp.where(draws.chance(0.5), 1.0, -1.0)
    is_seesaw = draws.chance(0.2)  # the pivot is about in the middle; then the arm is long enough for pivot and disc
    half = half.at[0].max(jnp.where(is_seesaw, 0.45, 0.0))
    out = jnp.where(is_seesaw, draws.between(0.0, 0.3), draws.between(0.5, 0.9)) * half[0]  # from pivot to middle
    inset = draws.between(0.6, 1.4) * ball
    gap = jnp.where(draws.chance(0.4), draws.between(0.05, 0.5), CLEARANCE_M)  # between the disc and the arm
    zero = jnp.zeros((), jnp.float32)
    middle_of_arm = jnp.where(is_upright, jnp.stack([zero, out]), jnp.stack([-side * out, zero]))
    end = out + half[0]
    on_tip = jnp.stack([zero, end + ball + gap])
    on_arm = jnp.stack([-side * (end - inset), half[1] + ball + gap])
    parts = [
        Part(position=jnp.zeros(2, jnp.float32), radius=pivot, is_fixed=True),
        Part(position=middle_of_arm, angle=jnp.where(is_upright, 0.5 * math.pi, 0.0), half=half),
        Part(position=jnp.where(is_upright, on_tip, on_arm), radius=ball, role=Role.GREEN),
    ]
    away = draws.between(jnp.maximum(0.9, half[0] - out + goal_radius + 0.1), 2.5)
    x = draws.between(WALL_MARGIN_M + end, WORLD_SIZE_M - WALL_MARGIN_M - away - goal_radius)
    low = FLOOR_TOP_M + jnp.maximum(0.4, half[0] - out + 0.05)
    y = draws.between(low, jnp.minimum(3.2, WORLD_SIZE_M - WALL_MARGIN_M - end - gap - 2.0 * ball))
    lowest = FLOOR_TOP_M + CLEARANCE_M + goal_radius
    goal_y = jnp.where(draws.chance(0.5), lowest, draws.between(lowest, jnp.maximum(lowest, y + 0.6)))
    return Mechanism(
        parts=parts,
        joints=[Joint(a=0, b=1, at=jnp.zeros(2, jnp.float32))],
        task=Task(
            middle=given(jnp.stack([jnp.where(side > 0.0, x, WORLD_SIZE_M - x), y])),
            goal=jnp.stack([side * away, goal_y - y]),
            goal_radius=given(goal_radius),
            has_full_motors=draws.chance(0.4),
            floor_is_red=given(draws.chance(0.4)),
        ),
    )
