"""Things of boxes, circles and motors, built about an origin and written into a draft of a level.

Used where a level holds one thing of a kind (`locomotion.py`, `goal_following.py`). Which parts there may be is known
when it is traced, which of them there are is not: each has its own slot and says whether it is active.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity, Thrusters
from kinetix_dist.level.draft import Draft, DrivenThrusters, Shapes, hinge_or_weld
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
        return _between(self._next(), low, high)

    def chance(self, share: float) -> Array:
        return self.between(0.0, 1.0) < share

    def number(self, low: int, high: int) -> Array:
        """int32, from low to high, both included."""
        return _number(self._next(), low, high)

    def rows(self, number: int, width: int) -> Array:
        """[number, width] of the next ones, row by row."""
        return self._numbers[self._use(number * width)].reshape(number, width)

    def _next(self) -> Array:
        return jax.lax.index_in_dim(self._numbers, self._use(1).start, keepdims=False)

    def _use(self, number: int) -> slice:
        first, self._used = self._used, self._used + number
        assert self._used <= _NUM_DRAWS  # JAX would give the last one again, or fewer
        return slice(first, self._used)


def _between(draw: Array, low: float | Array, high: Any) -> Array:
    return low + draw * (high - low)


def _number(draw: Array, low: int, high: int) -> Array:
    return jnp.floor(_between(draw, low, high + 1)).astype(jnp.int32)


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
    for is_box in (True, False):
        some = [part for part in parts if (part.half is not None) == is_box]
        if not some:
            continue
        position, active = _column([part.position for part in some]), _column([part.active for part in some], np.bool_)
        if is_box:
            angle, half = _column([part.angle for part in some]), _column([part.half for part in some])
            cos, sin = jnp.abs(jnp.cos(angle)), jnp.abs(jnp.sin(angle))
            reach = jnp.stack([cos * half[:, 0] + sin * half[:, 1], sin * half[:, 0] + cos * half[:, 1]], axis=1)
        else:
            reach = jnp.asarray(_column([part.radius for part in some]))[:, None]
        low.append(jnp.where(active[:, None], position - reach, jnp.inf).min(axis=0))
        high.append(jnp.where(active[:, None], position + reach, -jnp.inf).max(axis=0))
    return functools.reduce(jnp.minimum, low), functools.reduce(jnp.maximum, high)


def with_parts(draft: Draft, parts: list[Part], capacity: Capacity) -> tuple[Draft, list[int]]:
    """The draft with all parts, boxes in the first slots after the walls and circles in the first of theirs, and the
    slot of each."""
    shapes, slots = draft.shapes, [0] * len(parts)
    for is_box, first in ((True, NUM_WALLS), (False, capacity.polygons)):
        places = [place for place, part in enumerate(parts) if (part.half is not None) == is_box]
        if not places:
            continue
        some = [parts[place] for place in places]
        body = np.arange(first, first + len(some))
        corners, num_corners, radius = jnp.zeros((capacity.vertices, 2)), 0, 0.0
        if is_box:
            half = jnp.asarray(_column([part.half for part in some]))[:, None]
            corners, num_corners = box_or_triangle(half, np.False_, capacity.vertices)
        else:
            radius = _column([part.radius for part in some])
        active = _column([part.active for part in some], np.bool_)
        rows = Shapes(
            active=active,
            position=_column([part.position for part in some]),
            angle=_column([part.angle for part in some]),
            vertices=corners,
            num_vertices=num_corners,
            radius=radius,
            role=_column([part.role for part in some], np.int32),
            is_fixed=_column([part.is_fixed for part in some], np.bool_),
            body=body,
            num_joints=0,
            added_at=0,
        )
        shapes = _write_rows(shapes, first, rows, active)
        for place, slot in zip(places, body, strict=True):
            slots[place] = int(slot)
    return dataclasses.replace(draft, shapes=shapes), slots


def with_hinges(
    draws: Draws, draft: Draft, thing: Thing, slots: list[int], capacity: Capacity, config: GeneratorConfig
) -> Draft:
    """The draft, which has no joints yet, with motors: half of the time all of one colour, else each of any, unless the
    thing says otherwise."""
    one_colour = draws.chance(0.5)
    first = draws.number(0, NUM_MOTOR_COLOURS - 1)
    hinges = thing.hinges
    if not hinges:
        return draft
    a, b = (np.asarray([slots[end] for end in ends]) for ends in zip(*((hinge.a, hinge.b) for hinge in hinges)))
    is_wheel = np.maximum(a, b) >= capacity.polygons
    strongest = np.where(is_wheel, config.wheel_power_max, config.motor_power_max)
    # Drawn in this order: levels of a key stay what they are.
    speed_draw, power_draw, colour_draw = draws.rows(len(hinges), 3).T
    motor_speed = _between(speed_draw, config.motor_speed_min, config.motor_speed_max)
    motor_power = _between(power_draw, config.motor_power_min, strongest)
    colour = jnp.where(one_colour, first, _number(colour_draw, 0, NUM_MOTOR_COLOURS - 1))
    active, is_weld = (_column([getattr(hinge, name) for hinge in hinges], np.bool_) for name in ("active", "is_weld"))
    turn = jnp.cumsum(active & ~is_weld) - (active & ~is_weld)  # motors before it
    limit = _column([0.0 if hinge.limit is None else hinge.limit for hinge in hinges])
    at, position, angle = _column([hinge.at for hinge in hinges]), draft.shapes.position, draft.shapes.angle
    rows = hinge_or_weld(
        a=a,
        b=b,
        anchor_a=_local(position[a], angle[a], at),
        anchor_b=_local(position[b], angle[b], at),
        is_weld=is_weld,
        rest_angle=angle[b] - angle[a],
        motor_on=np.asarray([hinge.has_motor for hinge in hinges]),
        motor_speed=jnp.where(thing.has_full_motors, config.motor_speed_max, motor_speed),
        motor_power=jnp.where(thing.has_full_motors, strongest, motor_power),
        has_limits=np.asarray([hinge.limit is not None for hinge in hinges]),
        lower_limit=-limit,
        upper_limit=limit,
        colour=jnp.where(thing.colours_in_turn, (first + turn) % NUM_MOTOR_COLOURS, colour),
    )
    return dataclasses.replace(draft, driven_joints=_write_active(draft.driven_joints, rows, active))


def with_jets(draft: Draft, jets: list[Jet], slots: list[int]) -> Draft:
    """The draft with thrusters, in the first slots."""
    if not jets:
        return draft
    active = _column([jet.active for jet in jets], np.bool_)
    thrusters = Thrusters(
        active=active,
        body=jnp.asarray(slots)[_column([jet.of for jet in jets], np.int32)],
        position=_column([jet.at for jet in jets]),
        angle=_column([jet.angle for jet in jets]),
        power=_column([jet.power for jet in jets]),
    )
    rows = DrivenThrusters(thrusters=thrusters, colour=np.asarray([jet.colour for jet in jets]))
    return dataclasses.replace(draft, driven_thrusters=_write_rows(draft.driven_thrusters, 0, rows, active))


def _column(values: Sequence[Any], dtype: type[np.generic] = np.float32) -> Any:
    """[values, ...] one below the other; a numpy array where all of them are known when it is traced."""
    if any(isinstance(value, jax.Array) for value in values):
        return jnp.stack([jnp.asarray(value, dtype) for value in values])
    return np.asarray(values, dtype)


def _write_rows(table: Any, first: int, rows: Any, active: Any) -> Any:
    """`table` with rows from number `first` on replaced where `active` ([rows]); both are pytrees of one kind, and a
    column of `rows` may be one value for all."""
    number = len(active)

    def write(column: Array, values: Any) -> Array:
        old = column[first : first + number]
        new = jnp.where(_beside(active, old), jnp.asarray(values, column.dtype), old)
        return jax.lax.dynamic_update_slice_in_dim(column, new, first, axis=0)

    return jax.tree.map(write, table, rows)


def _write_active(table: Any, rows: Any, active: Any) -> Any:
    """`table` with those of `rows` that are active ([rows]) in its first rows, in their order; the rest stays."""
    number = len(active)
    if isinstance(active, np.ndarray) and active.all():
        return _write_rows(table, 0, rows, active)
    capacity = len(jax.tree.leaves(table)[0])
    here = active & (jnp.cumsum(active) - 1 == jnp.arange(capacity)[:, None])  # [table, rows]
    source, is_written = jnp.argmax(here, axis=1), here.any(axis=1)

    def write(column: Array, values: Any) -> Array:
        values = jnp.broadcast_to(jnp.asarray(values, column.dtype), (number, *column.shape[1:]))
        return jnp.where(_beside(is_written, column), _rows_at(values, source), column)

    return jax.tree.map(write, table, rows)


def _beside(mask: Any, column: Array) -> Any:
    """The mask ([n]) with as many axes as the column ([n, ...])."""
    return mask.reshape(mask.shape + (1,) * (column.ndim - 1))


def _rows_at(column: Array, places: Array) -> Array:
    return column.at[places].get(mode="promise_in_bounds", wrap_negative_indices=False)


def _local(position: Array, angle: Array, points: Array) -> Array:
    """[n, 2] m, points of the world in the frames of shapes, one each."""
    return world_corners(jnp.zeros(2), -angle, (points - position)[:, None])[:, 0]
