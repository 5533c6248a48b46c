"""Things of boxes, circles and motors, built about an origin; `thing_tables.py` writes them into a draft of a level.

Used where a level holds one thing of a kind (`locomotion.py`, `goal_following.py`). Which parts there may be is known
when it is traced, which of them there are is not: each has its own slot and says whether it is active.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import jax.numpy as jnp

from jax2d.fields import Array
from kinetix_dist import prng
from kinetix_dist.level.roles import Role

_NUM_DRAWS = 80


class Draws:
    """Uniform numbers, one after another; how many are used is known when it is traced."""

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
    """[80] uniform, enough for any thing and its level. Consumes `key`."""
    return prng.uniform(key, (_NUM_DRAWS,))


def between(draw: Array, low: float | Array, high: float | Array) -> Array:
    """A uniform number from 0 to 1 as one from low to high."""
    return low + draw * (high - low)


def number_between(draw: Array, low: int, high: int) -> Array:
    """The same as int32, both included."""
    return jnp.floor(between(draw, low, high + 1)).astype(jnp.int32)


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
    """A motor between two parts, by their places in the list of parts.

    limit: rad to both sides of the start, or of the angle `bend` (rad) from it. turn: where colours come in turn, that
    of its motor instead of the next one.
    """

    a: int
    b: int
    at: Array  # [2] m
    limit: Array | None = None
    bend: Array | float = 0.0
    has_motor: bool | Array = True
    turn: int | None = None
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
    goal_is_green: bool | Array = False  # green and blue are exchanged: red parts must not touch the goal
    # Of something that can go
    is_handed: bool = False  # it faces to the right, so that it is mirrored where the goal is to the left
    height: Array | float = 0.0  # m, of its lowest point above the floor
    goal_nearness: int | Array = 1  # the distance of the goal is a share of what there is room for, to this power
    goal_rise: tuple[float, float] = (0.0, 0.5)  # of the goal's lowest point above the floor, as shares of its height
    goal_height: Array | None = None  # m, of the goal's centre in the world, instead
    has_bump: bool = True  # sometimes, on the floor on the way
    gap: Array | None = None  # m, half of what two pillars on the way leave, if there are any
    num_blocks: int = 0  # in the air on the way, at most, where there are no pillars
    colours_in_turn: bool | Array = False  # each motor has the colour after that of the one before, see `with_table`
    has_full_motors: bool | Array = False  # all at the highest speed and power
    has_weak_motors: bool | Array = False  # all slow and weak: they hardly lift what they carry
    motor_power: Array | None = None  # of all motors, instead
    floor_is_red: Array | None = None  # None: as often as in all levels


def moved(thing: Thing, by: Array) -> Thing:
    """The thing, its origin at `by` ([2] m)."""
    parts = [dataclasses.replace(part, position=part.position + by) for part in thing.parts]
    hinges = [dataclasses.replace(hinge, at=hinge.at + by) for hinge in thing.hinges]
    return dataclasses.replace(thing, parts=parts, hinges=hinges)


def mirrored_jets(jets: Any, is_wanted: Array) -> Any:
    """A `Jet`, or a table of them, with left and right exchanged about the origin of what it pushes, where that is
    wanted."""
    flip = jnp.stack([jnp.where(is_wanted, -1.0, 1.0), jnp.ones((), jnp.float32)])
    return dataclasses.replace(jets, at=jets.at * flip, angle=jnp.where(is_wanted, math.pi - jets.angle, jets.angle))


def extent(parts: list[Part]) -> tuple[Array, Array]:
    """Lowest and highest x and y of the active parts, [2] each."""
    boxes = [part for part in parts if part.half is not None]
    circles = [part for part in parts if part.half is None]
    reaches = []
    if boxes:
        angle = jnp.stack([jnp.asarray(box.angle, jnp.float32) for box in boxes])
        reaches.append(reach_of_boxes(angle, jnp.stack([box.half for box in boxes])))
    if circles:
        reaches.append(reach_of_circles(jnp.stack([circle.radius for circle in circles])))
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
