"""Things as tables: rows of boxes, circles, hinges and jets, as many for each thing, so that one of several is chosen.

    table_of, of each thing -> choose -> Table.moved, Table.mirrored -> with_table, written into a draft of a level

Things are lists of parts (`things.py`), which suits whoever builds one. What is done to all of them is done here, once,
to the chosen one: a program that does it to each takes three times as long to trace and to compile.
"""

from __future__ import annotations

import collections
import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity, Thrusters
from kinetix_dist.level.draft import Draft, DrivenThrusters, Shapes, beside, hinge_or_weld, row_at
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_WALLS
from kinetix_dist.level.overlap import world_corners
from kinetix_dist.level.proposals import box_or_triangle
from kinetix_dist.level.things import (
    Draws,
    Part,
    Thing,
    between,
    extent_of,
    mirrored_jets,
    number_between,
    reach_of_boxes,
    reach_of_circles,
)

WEAK_SPEEDS, WEAK_POWERS = (0.5, 1.6), (0.2, 1.0)  # of motors, in units of a level
_NUMBER, _POINT, _COUNT, _FLAG = np.float32(0.0), np.zeros(2, np.float32), np.int32(0), np.False_


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Boxes:
    """As many rows as there are polygons besides the walls, about the origin of the thing."""

    position: Array  # [B, 2] m
    angle: Array  # [B] rad
    half: Array  # [B, 2] m, half extents
    role: Array  # [B] int32
    is_fixed: Array  # [B] bool
    active: Array  # [B] bool


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Circles:
    """As many rows as there are circles."""

    position: Array  # [C, 2] m
    angle: Array  # [C] rad
    radius: Array  # [C] m
    role: Array  # [C] int32
    is_fixed: Array  # [C] bool
    active: Array  # [C] bool


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Hinges:
    """As many rows as the thing with the most hinges has."""

    a: Array  # [H] int32, slot of a shape
    b: Array  # [H] int32
    at: Array  # [H, 2] m
    limit: Array  # [H] rad
    has_limit: Array  # [H] bool
    bend: Array  # [H] rad
    turn: Array  # [H] int32
    has_turn: Array  # [H] bool
    has_motor: Array  # [H] bool
    is_weld: Array  # [H] bool
    active: Array  # [H] bool


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Jets:
    """As many rows as there are thrusters."""

    of: Array  # [T] int32, slot of a shape
    at: Array  # [T, 2] m
    angle: Array  # [T] rad
    power: Array  # [T]
    colour: Array  # [T] int32
    active: Array  # [T] bool


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Given:
    """What a thing may say or leave open."""

    value: Array
    is_given: Array  # bool

    def otherwise(self, value: Any) -> Array:
        """What it says, or this."""
        return jnp.where(self.is_given, self.value, value)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """A thing. What is not explained is as in `Thing`."""

    boxes: Boxes
    circles: Circles
    hinges: Hinges
    jets: Jets
    num_boxes: Array  # int32, the rows after these are free
    num_circles: Array  # int32
    num_draws: Array  # int32, that it took to build the thing
    is_placed: Array  # bool: it cannot go anywhere, `middle` and `goal` say where it is
    middle: Array
    goal: Array
    goal_radius: Given
    slab: Given
    goal_is_slab: Array
    goal_is_green: Array
    is_handed: Array
    height: Array
    goal_nearness: Array
    is_nearness_known: Array  # bool, when it is traced
    goal_rise_low: Array
    goal_rise_span: Array  # from the lowest to the highest
    goal_height: Given
    has_bump: Array
    gap: Given
    colours_in_turn: Array
    has_full_motors: Array
    has_weak_motors: Array
    motor_power: Given
    floor_is_red: Given

    def extent(self) -> tuple[Array, Array]:
        """Lowest and highest x and y of the active parts, [2] each."""
        boxes, circles = self.boxes, self.circles
        return extent_of(
            jnp.concatenate([boxes.position, circles.position]),
            jnp.concatenate([reach_of_boxes(boxes.angle, boxes.half), reach_of_circles(circles.radius)]),
            jnp.concatenate([boxes.active, circles.active]),
        )

    def moved(self, by: Array) -> Table:
        """The thing, its origin at `by` ([2] m)."""
        return self._with_places(lambda place: place + by)

    def mirrored(self, is_wanted: Array) -> Table:
        """The thing with left and right exchanged, where that is wanted. Boxes and circles are their own mirror
        images."""
        sign = jnp.where(is_wanted, -1.0, 1.0)
        flip = jnp.stack([sign, jnp.ones((), jnp.float32)])
        return dataclasses.replace(
            self._with_places(lambda place: place * flip, lambda angle: angle * sign),
            jets=mirrored_jets(self.jets, is_wanted),
        )

    def _with_places(
        self, place: Callable[[Array], Array], angle: Callable[[Array], Array] = lambda same: same
    ) -> Table:
        """With other places of boxes, circles and hinges, and other angles of boxes and circles."""
        boxes, circles = (
            dataclasses.replace(rows, position=place(rows.position), angle=angle(rows.angle))
            for rows in (self.boxes, self.circles)
        )
        hinges = dataclasses.replace(self.hinges, at=place(self.hinges.at), bend=angle(self.hinges.bend))
        return dataclasses.replace(self, boxes=boxes, circles=circles, hinges=hinges)


@dataclasses.dataclass(frozen=True)
class _Column:
    """Values of one field, one by one, known when it is traced or not. empty: one that says nothing."""

    values: list[Any]
    empty: Any
    is_array: bool = True  # or it is one value


def table_of(thing: Thing, num_draws: int, capacity: Capacity, num_hinges: int) -> Table:
    """The table of a thing before `choose`, with room for so many hinges. num_draws: that it took to build it."""
    boxes = [part for part in thing.parts if part.half is not None]
    circles = [part for part in thing.parts if part.half is None]
    next_slot, slots = {True: NUM_WALLS, False: capacity.polygons}, []
    for part in thing.parts:
        slots.append(next_slot[part.half is not None])
        next_slot[part.half is not None] += 1
    of_part = {"position": _POINT, "angle": _NUMBER, "role": _COUNT, "is_fixed": _FLAG, "active": _FLAG}
    of_hinge = {"at": _POINT, "limit": _NUMBER, "bend": _NUMBER, "turn": _COUNT, "has_motor": _FLAG}
    of_hinge |= {"is_weld": _FLAG, "active": _FLAG}
    of_jet = {"at": _POINT, "angle": _NUMBER, "power": _NUMBER, "colour": _COUNT, "active": _FLAG}
    low, high = thing.goal_rise
    return Table(
        boxes=Boxes(**_columns(boxes, capacity.polygons - NUM_WALLS, half=_POINT, **of_part)),
        circles=Circles(**_columns(circles, capacity.circles, radius=_NUMBER, **of_part)),
        hinges=Hinges(
            a=_column([slots[hinge.a] for hinge in thing.hinges], num_hinges, _COUNT),
            b=_column([slots[hinge.b] for hinge in thing.hinges], num_hinges, _COUNT),
            has_limit=_column([hinge.limit is not None for hinge in thing.hinges], num_hinges, _FLAG),
            has_turn=_column([hinge.turn is not None for hinge in thing.hinges], num_hinges, _FLAG),
            **_columns(thing.hinges, num_hinges, **of_hinge),
        ),
        jets=Jets(
            of=_column([_slot_of(slots, jet.of) for jet in thing.jets], capacity.thrusters, _COUNT),
            **_columns(thing.jets, capacity.thrusters, **of_jet),
        ),
        num_boxes=_one(len(boxes), _COUNT),
        num_circles=_one(len(circles), _COUNT),
        num_draws=_one(num_draws, _COUNT),
        is_placed=_one(thing.middle is not None, _FLAG),
        middle=_one(thing.middle, _POINT),
        goal=_one(thing.goal, _POINT),
        goal_radius=_given(thing.goal_radius, _NUMBER),
        slab=_given(thing.slab, _POINT),
        goal_is_slab=_one(thing.goal_is_slab if thing.slab is not None else False, _FLAG),
        goal_is_green=_one(thing.goal_is_green, _FLAG),
        is_handed=_one(thing.is_handed, _FLAG),
        height=_one(thing.height, _NUMBER),
        goal_nearness=_one(thing.goal_nearness, _COUNT),
        is_nearness_known=_one(isinstance(thing.goal_nearness, int), _FLAG),
        goal_rise_low=_one(low, _NUMBER),
        goal_rise_span=_one(high - low, _NUMBER),
        goal_height=_given(thing.goal_height, _NUMBER),
        has_bump=_one(thing.has_bump, _FLAG),
        gap=_given(thing.gap, _NUMBER),
        colours_in_turn=_one(thing.colours_in_turn, _FLAG),
        has_full_motors=_one(thing.has_full_motors, _FLAG),
        has_weak_motors=_one(thing.has_weak_motors, _FLAG),
        motor_power=_given(thing.motor_power, _NUMBER),
        floor_is_red=_given(thing.floor_is_red, _FLAG),
    )


def _columns(rows: Sequence[Any], number: int, **empty: Any) -> dict[str, _Column]:
    """Those fields of the rows, of which `empty` says what there is in the rows after them."""
    return {name: _column([getattr(row, name) for row in rows], number, one) for name, one in empty.items()}


def _column(values: list[Any], number: int, empty: Any) -> _Column:
    if len(values) > number:
        raise ValueError(f"a thing has {len(values)} rows of a table that has room for {number}")
    values = [empty if value is None else value for value in values]
    return _Column(values + [empty] * (number - len(values)), empty)


def _one(value: Any, empty: Any) -> Any:
    return _Column([empty if value is None else value], empty, is_array=False)


def _given(value: Any, empty: Any) -> Given:
    return Given(value=_one(value, empty), is_given=_one(value is not None, _FLAG))


def _slot_of(slots: list[int], part: int | Array) -> int | Array:
    return slots[part] if isinstance(part, int) else row_at(np.asarray(slots), part)


def choose(tables: Sequence[Table], chosen: Array) -> Table:
    """The one of that number (int32), with arrays. What is the same in all and known when it is traced stays a numpy
    array."""
    columns = [jax.tree.leaves(table) for table in tables]
    places_of = collections.defaultdict(list)
    for place, column in enumerate(columns[0]):
        is_known = all(_is_known(value) for table in columns for value in table[place].values)
        places_of[column.empty.dtype, column.empty.shape, is_known].append(place)
    result: list[Any] = [None] * len(columns[0])
    # Those of one type and shape are chosen at once: each choice is work to trace and to compile.
    for (dtype, _, _), places in places_of.items():
        rows = [[value for place in places for value in table[place].values] for table in columns]
        values, start = _choose_row(rows, dtype, chosen), 0
        for place in places:
            column = columns[0][place]
            end = start + len(column.values)
            result[place] = values[start:end] if column.is_array else values[start]
            start = end
    return jax.tree.unflatten(jax.tree.structure(tables[0]), result)


def _is_known(value: Any) -> bool:
    """When it is traced."""
    return not isinstance(value, jax.Array)


def _choose_row(rows: list[list[Any]], dtype: np.dtype, chosen: Array) -> Array:
    """[values, ...] of one of the rows, which have as many values each."""
    if all(_is_known(value) for row in rows for value in row):
        known = np.asarray(rows, dtype)
        return known[0] if (known == known[0]).all() else row_at(known, chosen)
    # Of each row what is traced first, then what is known, as one constant; both are put in order after the choice.
    arrays, places = [], []
    for row in rows:
        traced = [place for place, value in enumerate(row) if not _is_known(value)]
        known = [place for place, value in enumerate(row) if _is_known(value)]
        pieces = [jnp.stack([jnp.asarray(row[place], dtype) for place in traced])] if traced else []
        pieces += [np.asarray([row[place] for place in known], dtype)] if known else []
        arrays.append(jnp.concatenate(pieces))
        places.append(np.argsort(traced + known))
    if len(rows) == 1:
        return row_at(arrays[0], places[0])
    return row_at(row_at(jnp.stack(arrays), chosen), row_at(np.stack(places), chosen))


def with_boxes(table: Table, parts: list[Part]) -> Table:
    """The table with boxes, each in its own row after those of the thing if it is active and there is such a row."""
    return dataclasses.replace(table, boxes=_with_rows(table.boxes, table.num_boxes, parts))


def with_circle(table: Table, part: Part) -> Table:
    """The table with a circle in the row after those of the thing, if it is active."""
    return dataclasses.replace(table, circles=_with_rows(table.circles, table.num_circles, [part]))


def _with_rows(rows: Any, first: Array, parts: list[Part]) -> Any:
    place = jnp.arange(len(rows.active)) - first
    is_active = functools.reduce(jnp.logical_or, [(place == row) & part.active for row, part in enumerate(parts)])

    def with_column(name: str) -> Array:
        old = jnp.asarray(getattr(rows, name))
        values = [jnp.asarray(getattr(part, name), old.dtype) for part in parts]
        new = row_at(jnp.stack(values), jnp.clip(place, 0, len(parts) - 1)) if len(parts) > 1 else values[0]
        return jnp.where(beside(is_active, old), new, old)

    return dataclasses.replace(rows, **{field.name: with_column(field.name) for field in dataclasses.fields(rows)})


def with_table(draws: Draws, draft: Draft, table: Table, capacity: Capacity, config: GeneratorConfig) -> Draft:
    """The draft of nothing but walls with the thing: boxes in the first slots after the walls, circles, joints and
    thrusters in the first ones.

    Half of the time all motors are of one colour, else each of any, unless the thing says otherwise.
    """
    shapes = _written(draft.shapes, _shape_rows(table, capacity), _of_slots(table, "active"))
    jets = table.jets
    thrusters = Thrusters(active=jets.active, body=jets.of, position=jets.at, angle=jets.angle, power=jets.power)
    driven = DrivenThrusters(thrusters=thrusters, colour=jets.colour)
    draft = dataclasses.replace(
        draft, shapes=shapes, driven_thrusters=_written(draft.driven_thrusters, driven, jets.active)
    )
    return _with_motors(draws, draft, table, capacity, config)


def _written(table: Any, rows: Any, active: Array) -> Any:
    """The table with the rows that are active ([n]); columns of `rows` may be one value for all."""
    return jax.tree.map(lambda old, new: jnp.where(beside(active, old), jnp.asarray(new, old.dtype), old), table, rows)


def _of_slots(table: Table, name: str) -> Array:
    """[n, ...] a column of boxes and circles, zeros for walls."""
    boxes, circles = getattr(table.boxes, name), getattr(table.circles, name)
    return jnp.concatenate([np.zeros((NUM_WALLS, *boxes.shape[1:]), boxes.dtype), boxes, circles])


def _shape_rows(table: Table, capacity: Capacity) -> Shapes:
    is_polygon = np.arange(capacity.shapes) < capacity.polygons
    half = jnp.pad(table.boxes.half, ((NUM_WALLS, capacity.circles), (0, 0)))[:, None]
    corners, _ = box_or_triangle(half, np.False_, capacity.vertices)
    return Shapes(
        active=_of_slots(table, "active"),
        position=_of_slots(table, "position"),
        angle=_of_slots(table, "angle"),
        vertices=corners,
        num_vertices=np.where(is_polygon, 4, 0),
        radius=jnp.pad(table.circles.radius, (capacity.polygons, 0)),
        role=_of_slots(table, "role"),
        is_fixed=_of_slots(table, "is_fixed"),
        body=np.arange(capacity.shapes),
        num_joints=0,
        added_at=0,
    )


def _with_motors(draws: Draws, draft: Draft, table: Table, capacity: Capacity, config: GeneratorConfig) -> Draft:
    hinges = table.hinges
    number = len(hinges.active)
    if not number:
        return draft
    one_colour = draws.chance(0.5)
    first = draws.number(0, NUM_MOTOR_COLOURS - 1)
    # Drawn in this order: levels of a key stay what they are.
    speed, power, colour = draws.rows(number, 3).T
    is_wheel = jnp.maximum(hinges.a, hinges.b) >= capacity.polygons
    lowest = jnp.where(table.has_weak_motors, WEAK_SPEEDS[0], config.motor_speed_min)
    speed = between(speed, lowest, jnp.where(table.has_weak_motors, WEAK_SPEEDS[1], config.motor_speed_max))
    strongest = jnp.where(is_wheel, config.wheel_power_max, config.motor_power_max)
    lowest = jnp.where(table.has_weak_motors, WEAK_POWERS[0], config.motor_power_min)
    power = between(power, lowest, jnp.where(table.has_weak_motors, WEAK_POWERS[1], strongest))
    colour = jnp.where(one_colour, first, number_between(colour, 0, NUM_MOTOR_COLOURS - 1))
    is_motor = jnp.asarray(hinges.active & ~hinges.is_weld)
    turn = jnp.where(hinges.has_turn, hinges.turn, jnp.cumsum(is_motor) - is_motor)  # or motors before it
    shapes, a, b = draft.shapes, hinges.a, hinges.b
    angle_a, angle_b = row_at(shapes.angle, a), row_at(shapes.angle, b)
    rows = hinge_or_weld(
        a=a,
        b=b,
        anchor_a=_local(row_at(shapes.position, a), angle_a, hinges.at),
        anchor_b=_local(row_at(shapes.position, b), angle_b, hinges.at),
        is_weld=hinges.is_weld,
        rest_angle=angle_b - angle_a,
        motor_on=hinges.has_motor,
        motor_speed=jnp.where(table.has_full_motors, config.motor_speed_max, speed),
        motor_power=table.motor_power.otherwise(jnp.where(table.has_full_motors, strongest, power)),
        has_limits=hinges.has_limit,
        lower_limit=hinges.bend - hinges.limit,
        upper_limit=hinges.bend + hinges.limit,
        colour=jnp.where(table.colours_in_turn, (first + turn) % NUM_MOTOR_COLOURS, colour),
    )
    # The active ones in the first slots, in their order.
    active = jnp.asarray(hinges.active)
    slots = np.arange(capacity.joints)
    here = active & (jnp.cumsum(active) - 1 == slots[:, None])  # [J, H]
    source, is_written = jnp.argmax(here, axis=1), here.any(axis=1)
    rows = jax.tree.map(lambda column: _at_rows(column, number, source), rows)
    return dataclasses.replace(draft, driven_joints=_written(draft.driven_joints, rows, is_written))


def _at_rows(column: Any, number: int, places: Array) -> Any:
    """Rows of a column; one value for all stays that."""
    return row_at(column, places) if np.ndim(column) and len(column) == number else column


def _local(position: Array, angle: Array, points: Array) -> Array:
    """[n, 2] m, points of the world in the frames of shapes, one each."""
    return world_corners(np.zeros(2, np.float32), -angle, (points - position)[:, None])[:, 0]
