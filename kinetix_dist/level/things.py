"""Things of boxes, circles and motors, built about an origin and written into a draft of a level.

Used where a level holds one thing of a kind (`locomotion.py`, `goal_following.py`). Which parts there may be is known
when it is traced, which of them there are is not: each has its own slot and says whether it is active.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import Capacity, Thrusters
from kinetix_dist.level.draft import Draft, DrivenThrusters, Shapes, first_free, hinge_or_weld, read_slot, write_slot
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
        assert self._used < _NUM_DRAWS  # JAX would give the last one again
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
    has_motor: bool = True
    is_weld: bool | Array = False  # instead: the two are one body
    active: bool | Array = True


@dataclasses.dataclass(frozen=True, kw_only=True)
class Jet:
    """A thruster on a part. at and angle (rad, of the push) are in the frame of the part."""

    of: int | Array
    at: Array  # [2] m
    angle: Array
    power: Array
    colour: int
    active: bool | Array = True


@dataclasses.dataclass(frozen=True, kw_only=True)
class Thing:
    """What is built, and what its level is to be like."""

    parts: list[Part]
    hinges: list[Hinge]
    jets: list[Jet] = dataclasses.field(default_factory=list)
    # Of something that cannot go anywhere; None: it can, and the goal is to be to the right of it
    middle: Array | None = None  # [2] m, where its origin is in the world
    goal: Array | None = None  # [2] m, from its origin
    goal_radius: Array | None = None  # m, None: as drawn for all
    slab: Array | None = None  # [2] m, half extents of a goal that lies on the floor instead
    goal_is_slab: bool | Array = True  # where there is a slab: or it is a disc, as drawn for all
    # Of something that can go
    is_handed: bool = False  # it faces to the right, so that it is mirrored where the goal is to the left
    height: Array | float = 0.0  # m, of its lowest point above the floor
    goal_nearness: int | Array = 1  # the distance of the goal is a share of what there is room for, to this power
    goal_rise: tuple[float, float] = (0.0, 0.5)  # of the goal's lowest point above the floor, as shares of its height
    goal_height: Array | None = None  # m, of the goal's centre in the world, instead
    has_bump: bool = True  # sometimes, on the floor on the way
    gap: Array | None = None  # m, half of what two pillars on the way leave, if there are any
    num_blocks: int = 0  # in the air on the way, at most, where there are no pillars
    colours_in_turn: bool | Array = False  # each motor has the colour after that of the one before, see `with_hinges`
    has_full_motors: bool | Array = False  # all at the highest speed and power
    floor_is_red: Array | None = None  # None: as often as in all levels


def moved(thing: Thing, by: Array) -> Thing:
    """The thing, its origin at `by` ([2] m)."""
    parts = [dataclasses.replace(part, position=part.position + by) for part in thing.parts]
    hinges = [dataclasses.replace(hinge, at=hinge.at + by) for hinge in thing.hinges]
    return dataclasses.replace(thing, parts=parts, hinges=hinges)


def mirrored(thing: Thing, is_wanted: Array) -> Thing:
    """The thing with left and right exchanged, where that is wanted. Boxes and circles are their own mirror images."""
    sign = jnp.where(is_wanted, -1.0, 1.0)
    flip = jnp.stack([sign, jnp.ones(())])
    parts = [dataclasses.replace(one, position=one.position * flip, angle=one.angle * sign) for one in thing.parts]
    hinges = [dataclasses.replace(hinge, at=hinge.at * flip) for hinge in thing.hinges]
    jets = [
        dataclasses.replace(jet, at=jet.at * flip, angle=jnp.where(is_wanted, math.pi - jet.angle, jet.angle))
        for jet in thing.jets
    ]
    return dataclasses.replace(thing, parts=parts, hinges=hinges, jets=jets)


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
    draws: Draws, draft: Draft, thing: Thing, slots: list[int], capacity: Capacity, config: GeneratorConfig
) -> Draft:
    """The draft with motors: half of the time all of one colour, else each of any, unless the thing says otherwise."""
    one_colour = draws.chance(0.5)
    first = draws.number(0, NUM_MOTOR_COLOURS - 1)
    joints, turn = draft.driven_joints, jnp.zeros((), jnp.int32)
    for hinge in thing.hinges:
        a, b = slots[hinge.a], slots[hinge.b]
        is_wheel = max(a, b) >= capacity.polygons
        strongest = config.wheel_power_max if is_wheel else config.motor_power_max
        limit = jnp.zeros(()) if hinge.limit is None else hinge.limit
        of_a, of_b = read_slot(draft.shapes, a), read_slot(draft.shapes, b)
        is_weld = jnp.asarray(hinge.is_weld)
        # Drawn in this order: levels of a key stay what they are.
        motor_speed = draws.between(config.motor_speed_min, config.motor_speed_max)
        motor_power = draws.between(config.motor_power_min, strongest)
        motor_speed = jnp.where(thing.has_full_motors, config.motor_speed_max, motor_speed)
        motor_power = jnp.where(thing.has_full_motors, strongest, motor_power)
        colour = jnp.where(one_colour, first, draws.number(0, NUM_MOTOR_COLOURS - 1))
        joint = hinge_or_weld(
            a=a,
            b=b,
            anchor_a=_local(of_a, hinge.at),
            anchor_b=_local(of_b, hinge.at),
            is_weld=is_weld,
            rest_angle=of_b.angle - of_a.angle,
            motor_on=jnp.array(hinge.has_motor),
            motor_speed=motor_speed,
            motor_power=motor_power,
            has_limits=jnp.array(hinge.limit is not None),
            lower_limit=-limit,
            upper_limit=limit,
            colour=jnp.where(thing.colours_in_turn, (first + turn) % NUM_MOTOR_COLOURS, colour),
        )
        turn = turn + (jnp.asarray(hinge.active) & ~is_weld)
        joints = write_slot(joints, first_free(joints.joints.active), joint, jnp.asarray(hinge.active))
    return dataclasses.replace(draft, driven_joints=joints)


def with_jets(draft: Draft, jets: list[Jet], slots: list[int]) -> Draft:
    """The draft with thrusters, in the first slots."""
    thrusters = draft.driven_thrusters
    for slot, jet in enumerate(jets):
        row = Thrusters(
            active=jnp.asarray(jet.active),
            body=jnp.asarray(slots)[jet.of],
            position=jet.at,
            angle=jet.angle,
            power=jet.power,
        )
        driven = DrivenThrusters(thrusters=row, colour=jnp.array(jet.colour))
        thrusters = write_slot(thrusters, jnp.array(slot), driven, jnp.asarray(jet.active))
    return dataclasses.replace(draft, driven_thrusters=thrusters)


def _local(shape: Shapes, point: Array) -> Array:
    """[2] m, a point of the world in the frame of a shape."""
    return world_corners(jnp.zeros(2), -shape.angle, (point - shape.position)[None])[0]
