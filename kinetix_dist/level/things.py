"""Things of boxes, circles and motors, built about an origin and written into a draft of a level.

Used where a level holds one thing of a kind (`locomotion.py`, `goal_following.py`). Which parts there may be is known
when it is traced, which of them there are is not: each has its own slot and says whether it is active.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity
from kinetix_dist.level.draft import Draft, Shapes, first_free, hinge_or_weld, read_slot, write_slot
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_WALLS
from kinetix_dist.level.overlap import world_corners
from kinetix_dist.level.proposals import box_or_triangle
from kinetix_dist.level.roles import Role

_NUM_DRAWS = 64


class Draws:
    """Uniform numbers, one after another; how many are used is known when it is traced."""

    def __init__(self, key: Array) -> None:
        self._numbers = jax.random.uniform(key, (_NUM_DRAWS,))
        self._used = 0

    def between(self, low: float | Array, high: float | Array) -> Array:
        draw = self._numbers[self._used]
        self._used += 1
        return low + draw * (high - low)

    def chance(self, share: float) -> Array:
        return self.between(0.0, 1.0) < share

    def number(self, low: int, high: int) -> Array:
        """int32, from low to high, both included."""
        return jnp.floor(self.between(low, high + 1)).astype(jnp.int32)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """A box (half extents) or a circle (radius) of the thing, about the thing's origin."""

    position: Array  # [2] m
    angle: Array | float = 0.0
    half: Array | None = None  # [2] m
    radius: Array | None = None
    role: int | Array = Role.NONE
    is_fixed: bool | Array = False
    active: bool | Array = True


@dataclasses.dataclass(frozen=True, kw_only=True)
class Hinge:
    """A motor between two parts, by their places in the list of parts. limit: rad to both sides of the start."""

    a: int
    b: int
    at: Array  # [2] m
    limit: Array | None = None
    active: bool | Array = True


@dataclasses.dataclass(frozen=True, kw_only=True)
class Thing:
    """What is built: parts, hinges, and where the goal of something that cannot go anywhere is (None: it can go)."""

    parts: list[Part]
    hinges: list[Hinge]
    middle: Array | None = None  # [2] m, where its origin is in the world
    goal: Array | None = None  # [2] m, from its origin


def extent(parts: list[Part]) -> tuple[Array, Array]:
    """Lowest and highest x and y of the active parts, [2] each."""
    low, high = [], []
    for part in parts:
        if part.half is None:
            reach = jnp.stack([part.radius, part.radius])
        else:
            cos, sin = jnp.abs(jnp.cos(part.angle)), jnp.abs(jnp.sin(part.angle))
            reach = jnp.stack([cos * part.half[0] + sin * part.half[1], sin * part.half[0] + cos * part.half[1]])
        low.append(jnp.where(part.active, part.position - reach, jnp.inf))
        high.append(jnp.where(part.active, part.position + reach, -jnp.inf))
    return jnp.min(jnp.stack(low), axis=0), jnp.max(jnp.stack(high), axis=0)


def with_parts(draft: Draft, parts: list[Part], capacity: Capacity) -> tuple[Draft, list[int]]:
    """The draft with all parts, and the slot of each."""
    next_slot = {True: NUM_WALLS, False: capacity.polygons}
    slots, shapes = [], draft.shapes
    for part in parts:
        is_box = part.half is not None
        slot, next_slot[is_box] = next_slot[is_box], next_slot[is_box] + 1
        half = part.half if part.half is not None else jnp.zeros(2)
        corners, num_corners = box_or_triangle(half, jnp.array(False), capacity.vertices)
        row = Shapes(
            active=part.active,
            position=part.position,
            angle=part.angle,
            vertices=corners,
            num_vertices=num_corners if is_box else 0,
            radius=0.0 if is_box else part.radius,
            role=part.role,
            is_fixed=part.is_fixed,
            body=slot,
            num_joints=0,
            added_at=0,
        )
        shapes = write_slot(shapes, slot, row, jnp.asarray(part.active))
        slots.append(slot)
    return dataclasses.replace(draft, shapes=shapes), slots


def with_hinges(
    draws: Draws, draft: Draft, hinges: list[Hinge], slots: list[int], capacity: Capacity, config: GeneratorConfig
) -> Draft:
    """The draft with motors; half of the time all of one colour."""
    one_colour = draws.chance(0.5)
    first = draws.number(0, NUM_MOTOR_COLOURS - 1)
    joints = draft.driven_joints
    for hinge in hinges:
        a, b = slots[hinge.a], slots[hinge.b]
        is_wheel = max(a, b) >= capacity.polygons
        strongest = config.wheel_power_max if is_wheel else config.motor_power_max
        limit = jnp.zeros(()) if hinge.limit is None else hinge.limit
        of_a, of_b = read_slot(draft.shapes, a), read_slot(draft.shapes, b)
        joint = hinge_or_weld(
            a=a,
            b=b,
            anchor_a=_local(of_a, hinge.at),
            anchor_b=_local(of_b, hinge.at),
            is_weld=jnp.array(False),
            rest_angle=of_b.angle - of_a.angle,
            motor_on=jnp.array(True),
            motor_speed=draws.between(config.motor_speed_min, config.motor_speed_max),
            motor_power=draws.between(config.motor_power_min, strongest),
            has_limits=jnp.array(hinge.limit is not None),
            lower_limit=-limit,
            upper_limit=limit,
            colour=jnp.where(one_colour, first, draws.number(0, NUM_MOTOR_COLOURS - 1)),
        )
        joints = write_slot(joints, first_free(joints.joints.active), joint, jnp.asarray(hinge.active))
    return dataclasses.replace(draft, driven_joints=joints)


def _local(shape: Shapes, point: Array) -> Array:
    """[2] m, a point of the world in the frame of a shape."""
    return world_corners(jnp.zeros(2), -shape.angle, (point - shape.position)[None])[0]
