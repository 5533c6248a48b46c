"""Templates of mechanisms: boxes, circles, joints and thrusters about an origin, as a family builds them.

    build(draws, capacity) -> Mechanism -> table.py: rows of arrays -> to_draft.py: slots of a level

A template is built while a program is traced. Which parts there may be is fixed then; which of them exist may be
drawn, so each part has its own slot and an `active` flag. Every field is declared here once with `entry`; the tables
of `table.py` are derived from these declarations.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from kinetix_dist import prng
from kinetix_dist.level.level import Role

Row = TypeVar("Row", bound="Part | Joint | Thruster")
Thrust = TypeVar("Thrust", bound="Thruster")

# Types of entries, each as the value of a row that is not in use.
NUMBER, POINT, COUNT, FLAG = np.float32(0.0), np.zeros(2, np.float32), np.int32(0), np.False_
EMPTY = "empty"  # key of that value in the metadata of a field
WALL_MARGIN_M = 0.1  # from a wall to the nearest shape
CLEARANCE_M = 0.01  # above a carrying surface, so that nothing touches at the start
GRAVITY_M_S2 = 9.81
NEWTON = 0.1  # thruster power that gives one
_NUM_DRAWS = 80


class Draws:
    """Uniform numbers, used one after another. How many are used is known when a program is traced."""

    def __init__(self, numbers: Sequence[Array]) -> None:
        """numbers: as of `jax.lax.unstack(draw_numbers(key))`."""
        self._numbers = numbers
        self.num_used = 0

    def between(self, low: float | Array, high: float | Array) -> Array:
        return between(self._numbers[self._use(1).start], low, high)

    def chance(self, share: float) -> Array:
        return self.between(0.0, 1.0) < share

    def number(self, low: int, high: int) -> Array:
        """int32, from low to high, both included."""
        return number_between(self._numbers[self._use(1).start], low, high)

    def rows(self, number: int, width: int) -> Array:
        """[number, width] of the next ones, row by row."""
        return jnp.stack(self._numbers[self._use(number * width)]).reshape(number, width)

    def _use(self, number: int) -> slice:
        first, self.num_used = self.num_used, self.num_used + number
        assert self.num_used <= len(self._numbers)  # a slice would be shorter
        return slice(first, self.num_used)


def draw_numbers(key: Array) -> Array:
    """[80] uniform, enough for any mechanism and its level. Consumes `key`."""
    return prng.uniform(key, (_NUM_DRAWS,))


def between(draw: Array, low: float | Array, high: float | Array) -> Array:
    """A uniform number from 0 to 1 as one from low to high."""
    return low + draw * (high - low)


def number_between(draw: Array, low: int, high: int) -> Array:
    """The same as int32, both included."""
    return jnp.floor(between(draw, low, high + 1)).astype(jnp.int32)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Optional:
    """A value that a template may leave open."""

    value: Array | None
    is_given: Array | bool

    @property
    def filled(self) -> Array:
        """The value in a table, which has one for every row, also for rows that leave it open."""
        assert self.value is not None
        return self.value

    def or_else(self, value: Any) -> Array:
        return jnp.where(self.is_given, self.filled, value)


def given(value: Any) -> Optional:
    return Optional(value, True)


OPEN = Optional(None, False)


def entry(empty: Any, default: Any = dataclasses.MISSING) -> Any:
    """Declares a field of a template: its type, as the value of a row that is not in use, and its default."""
    return dataclasses.field(default=default, metadata={EMPTY: empty})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """A box (`half`) or a circle (`radius`) about the origin of the mechanism; rows of one kind in a table."""

    position: Array = entry(POINT)  # [2] m
    angle: Array | float = entry(NUMBER, 0.0)  # rad
    half: Array | None = entry(POINT, None)  # [2] m, half extents
    radius: Array | None = entry(NUMBER, None)  # m
    role: int | Array = entry(COUNT, Role.NONE)
    is_fixed: bool | Array = entry(FLAG, False)
    active: bool | Array = entry(FLAG, True)

    @property
    def half_of_box(self) -> Array:
        """`half` of a box."""
        assert self.half is not None
        return self.half

    @property
    def radius_of_circle(self) -> Array:
        """`radius` of a circle."""
        assert self.radius is not None
        return self.radius


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Joint:
    """A hinge or a weld of two parts. a, b: their indices in the list of parts; slots of shapes in a table."""

    a: int | Array = entry(COUNT)
    b: int | Array = entry(COUNT)
    at: Array = entry(POINT)  # [2] m, from the origin of the mechanism
    limit: Optional = entry(NUMBER, OPEN)  # rad, to both sides of the start or of `bend`
    bend: Array | float = entry(NUMBER, 0.0)  # rad, middle of the limits
    has_motor: bool | Array = entry(FLAG, True)
    turn: Optional = entry(COUNT, OPEN)  # place in the order of `colours_in_turn`; open: that after the motor before
    is_weld: bool | Array = entry(FLAG, False)
    active: bool | Array = entry(FLAG, True)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Thruster:
    """A thruster on a part, in the frame of that part. part: its index; the slot of a shape in a table."""

    part: int | Array = entry(COUNT)
    at: Array = entry(POINT)  # [2] m
    angle: Array | float = entry(NUMBER)  # rad, of the push
    power: Array = entry(NUMBER)
    colour: int | Array = entry(COUNT)
    active: bool | Array = entry(FLAG, True)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """Goal, obstacles, floor and motors that a mechanism requests for its level. Distances are m."""

    # Of a mechanism that stays in its place. Open: it can go, and its goal is to the right of it
    middle: Optional = entry(POINT, OPEN)  # [2], its origin in the world
    goal: Array | tuple[float, float] = entry(POINT, (0.0, 0.0))  # [2], from its origin
    # Goal
    goal_radius: Optional = entry(NUMBER, OPEN)
    slab: Optional = entry(POINT, OPEN)  # [2], half extents of a goal that lies on the floor instead
    goal_is_slab: bool | Array = entry(FLAG, False)  # where a slab is given: it is used, else a disc
    goal_is_green: bool | Array = entry(FLAG, False)  # green and blue are exchanged: red parts must not touch the goal
    # Of a mechanism that can go
    is_handed: bool = entry(FLAG, False)  # it faces to the right: it is mirrored where the goal is to the left
    height: Array | float = entry(NUMBER, 0.0)  # of its lowest point above the floor
    goal_nearness: int = entry(COUNT, 1)  # the distance, as a share of the free length, is taken to this power
    drawn_nearness: Optional = entry(COUNT, OPEN)  # a drawn power instead: x**n and x*x differ in their last bits
    goal_rise_low: float = entry(NUMBER, 0.0)  # lowest point of the goal above the floor, as a share of its height
    goal_rise_span: float = entry(NUMBER, 0.5)  # from the lowest to the highest such share
    goal_height: Optional = entry(NUMBER, OPEN)  # of the goal's centre in the world, instead
    has_bump: bool | Array = entry(FLAG, True)  # there may be one on the floor on the way
    gap: Optional = entry(
        NUMBER, OPEN
    )  # half of the opening between pillars on the way; given: there are pillars or blocks
    # Motors and floor
    colours_in_turn: bool | Array = entry(FLAG, False)  # each motor has the colour after that of the one before
    has_full_motors: bool | Array = entry(FLAG, False)  # all at the highest speed and power
    has_weak_motors: bool | Array = entry(FLAG, False)  # all slow and weak: they hardly lift their load
    motor_power: Optional = entry(NUMBER, OPEN)  # of all motors, instead
    floor_is_red: Optional = entry(FLAG, OPEN)  # open: as often as in all levels


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mechanism:
    """The template of one mechanism and its task."""

    parts: list[Part]
    joints: list[Joint] = dataclasses.field(default_factory=list)
    thrusters: list[Thruster] = dataclasses.field(default_factory=list)
    task: Task = Task()
    num_blocks: int = 0  # at most, in the air on the way, where a gap is given and there are no pillars


def moved(mechanism: Mechanism, by: Array) -> Mechanism:
    """The mechanism, its origin at `by` ([2] m)."""
    parts = [dataclasses.replace(part, position=part.position + by) for part in mechanism.parts]
    joints = [dataclasses.replace(joint, at=joint.at + by) for joint in mechanism.joints]
    return dataclasses.replace(mechanism, parts=parts, joints=joints)


def mirrored_thrusters(thrusters: Thrust, is_wanted: Array) -> Thrust:
    """One thruster or rows of them, left and right exchanged about the origin of the part, where that is wanted."""
    flip = jnp.stack([jnp.where(is_wanted, -1.0, 1.0), jnp.ones((), jnp.float32)])
    angle = jnp.where(is_wanted, math.pi - thrusters.angle, thrusters.angle)
    return dataclasses.replace(thrusters, at=thrusters.at * flip, angle=angle)


def extent(parts: list[Part]) -> tuple[Array, Array]:
    """Lowest and highest x and y of the active parts, [2] each."""
    boxes = [part for part in parts if part.half is not None]
    circles = [part for part in parts if part.half is None]
    reaches = []
    if boxes:
        angle = jnp.stack([jnp.asarray(box.angle, jnp.float32) for box in boxes])
        reaches.append(reach_of_boxes(angle, jnp.stack([box.half_of_box for box in boxes])))
    if circles:
        reaches.append(reach_of_circles(jnp.stack([circle.radius_of_circle for circle in circles])))
    position, active = (jnp.stack([getattr(part, name) for part in boxes + circles]) for name in ("position", "active"))
    return extent_of(position, jnp.concatenate(reaches), active)


def extent_of(position: Array, reach: Array, active: Array) -> tuple[Array, Array]:
    """Lowest and highest x and y, [2] each, of active shapes at [n, 2] that reach so far to both sides, [n, 2] m."""
    low = jnp.where(active[:, None], position - reach, jnp.inf)
    high = jnp.where(active[:, None], position + reach, -jnp.inf)
    return low.min(axis=0), high.max(axis=0)


def reach_of_boxes(angle: Array, half: Array) -> Array:
    """[n, 2] m along x and y from their centres, of boxes of half extents [n, 2]."""
    cos, sin = jnp.abs(jnp.cos(angle)), jnp.abs(jnp.sin(angle))
    return jnp.stack([cos * half[:, 0] + sin * half[:, 1], sin * half[:, 0] + cos * half[:, 1]], axis=1)


def reach_of_circles(radius: Array) -> Array:
    """[n, 2] m along x and y from their centres."""
    return jnp.stack([radius, radius], axis=1)
