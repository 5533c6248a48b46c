"""Tables of mechanisms: columns of boxes, circles, joints and thrusters, so that one mechanism of several is chosen.

    table_of, of each mechanism -> choose -> Table.moved, Table.mirrored -> to_draft.py: slots of a level

All tables of one `choose` have as many rows. Work on the chosen table is traced and compiled once; done to each
mechanism it takes three times as long.
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
from jax2d.scene import Capacity
from kinetix_dist.level.draft import mask_like, row_at
from kinetix_dist.level.level import NUM_WALLS
from kinetix_dist.level.mechanisms.template import (
    COUNT,
    EMPTY,
    FLAG,
    OPEN,
    Joint,
    Mechanism,
    Optional,
    Part,
    Row,
    Task,
    Thruster,
    extent_of,
    mirrored_thrusters,
    reach_of_boxes,
    reach_of_circles,
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """A mechanism as columns. Rows after those of the mechanism are not active."""

    boxes: Part  # [B, ...], as many rows as there are polygons besides the walls
    circles: Part  # [C, ...], as many as there are circles
    joints: Joint  # [H, ...], as many as the mechanism with the most joints has
    thrusters: Thruster  # [T, ...], as many as there are thrusters
    num_boxes: Array  # int32, the rows after these are free
    num_circles: Array  # int32
    num_draws: Array  # int32, numbers that it took to build the mechanism
    task: Task

    def extent(self) -> tuple[Array, Array]:
        """Lowest and highest x and y of the active parts, [2] each."""
        boxes, circles = self.boxes, self.circles
        return extent_of(
            jnp.concatenate([boxes.position, circles.position]),
            jnp.concatenate(
                [reach_of_boxes(boxes.angle, boxes.half_of_box), reach_of_circles(circles.radius_of_circle)]
            ),
            jnp.concatenate([boxes.active, circles.active]),
        )

    def moved(self, by: Array) -> Table:
        """The mechanism, its origin at `by` ([2] m)."""
        return self._transformed(lambda point: point + by)

    def mirrored(self, is_wanted: Array) -> Table:
        """The mechanism with left and right exchanged, where that is wanted. Boxes and circles are their own mirror
        images."""
        sign = jnp.where(is_wanted, -1.0, 1.0)
        flip = jnp.stack([sign, jnp.ones((), jnp.float32)])
        return dataclasses.replace(
            self._transformed(lambda point: point * flip, lambda angle: angle * sign),
            thrusters=mirrored_thrusters(self.thrusters, is_wanted),
        )

    def _transformed(
        self, point: Callable[[Array], Array], angle: Callable[[Array], Array] = lambda same: same
    ) -> Table:
        """The table after a map of the positions of boxes, circles and joints, and one of their angles."""
        boxes, circles = (
            dataclasses.replace(rows, position=point(rows.position), angle=angle(rows.angle))
            for rows in (self.boxes, self.circles)
        )
        joints = dataclasses.replace(self.joints, at=point(self.joints.at), bend=angle(self.joints.bend))
        return dataclasses.replace(self, boxes=boxes, circles=circles, joints=joints)


@dataclasses.dataclass(frozen=True)
class _Column:
    """Values of one field before the choice, each known when a program is traced or not."""

    values: list[Any]
    empty: Any  # value of a row that is not in use
    is_array: bool = True  # or it is one value


def table_of(mechanism: Mechanism, num_draws: int, capacity: Capacity, num_joints: int) -> Table:
    """The table of a mechanism before `choose`, with rows for so many joints. num_draws: numbers that it took."""
    boxes = [part for part in mechanism.parts if part.half is not None]
    circles = [part for part in mechanism.parts if part.half is None]
    next_slot, slots = {True: NUM_WALLS, False: capacity.polygons}, []
    for part in mechanism.parts:
        slots.append(next_slot[part.half is not None])
        next_slot[part.half is not None] += 1
    joints = [
        dataclasses.replace(joint, a=_slot_of(slots, joint.a), b=_slot_of(slots, joint.b)) for joint in mechanism.joints
    ]
    thrusters = [dataclasses.replace(one, part=_slot_of(slots, one.part)) for one in mechanism.thrusters]
    return Table(
        boxes=_rows(Part, boxes, capacity.polygons - NUM_WALLS, without="radius"),
        circles=_rows(Part, circles, capacity.circles, without="half"),
        joints=_rows(Joint, joints, num_joints),
        thrusters=_rows(Thruster, thrusters, capacity.thrusters),
        num_boxes=_single([len(boxes)], COUNT),
        num_circles=_single([len(circles)], COUNT),
        num_draws=_single([num_draws], COUNT),
        task=Task(**_columns(Task, [mechanism.task], _single)),
    )


def _rows(kind: type[Row], rows: Sequence[Row], number: int, without: str = "") -> Row:
    """Columns of so many rows, the last ones not in use; the field `without` stays None."""
    if len(rows) > number:
        raise ValueError(f"a mechanism has {len(rows)} rows of a table that has room for {number}")
    columns = _columns(kind, rows, lambda values, empty: _Column(values + [empty] * (number - len(values)), empty))
    return kind(**columns | ({without: None} if without else {}))


def _columns(kind: type, rows: Sequence[Any], column: Callable[[list[Any], Any], Any]) -> dict[str, Any]:
    """A column of each field that `kind` declares; two of those that a template may leave open."""
    columns = {}
    for field in dataclasses.fields(kind):
        empty, values = field.metadata[EMPTY], [getattr(row, field.name) for row in rows]
        if field.default is OPEN:
            given = [empty if one.value is None else one.value for one in values]
            columns[field.name] = Optional(column(given, empty), column([one.is_given for one in values], FLAG))
        else:
            columns[field.name] = column(values, empty)
    return columns


def _single(values: list[Any], empty: Any) -> Any:
    return _Column(values, empty, is_array=False)


def _slot_of(slots: list[int], part: int | Array) -> int | Array:
    return slots[part] if isinstance(part, int) else row_at(np.asarray(slots), part)


def choose(tables: Sequence[Table], chosen: Array) -> Table:
    """The table of that number (int32), with arrays. Values that are the same in all tables and known when the program
    is traced stay numpy arrays."""
    columns = [jax.tree.leaves(table) for table in tables]
    groups = collections.defaultdict(list)  # numbers of columns
    for number, column in enumerate(columns[0]):
        is_known = all(_is_known(value) for table in columns for value in table[number].values)
        groups[column.empty.dtype, column.empty.shape, is_known].append(number)
    result: list[Any] = [None] * len(columns[0])
    # Columns of one type and shape are chosen at once: each choice is work to trace and to compile.
    for (dtype, _, _), numbers in groups.items():
        rows = [[value for number in numbers for value in table[number].values] for table in columns]
        values, start = _choose_row(rows, dtype, chosen), 0
        for number in numbers:
            column = columns[0][number]
            end = start + len(column.values)
            result[number] = values[start:end] if column.is_array else values[start]
            start = end
    return jax.tree.unflatten(jax.tree.structure(tables[0]), result)


def _is_known(value: Any) -> bool:
    """True of a value that is known when the program is traced."""
    return not isinstance(value, jax.Array)


def _choose_row(rows: list[list[Any]], dtype: np.dtype, chosen: Array) -> Array:
    """[values, ...] of one of the rows, which have as many values each."""
    if all(_is_known(value) for row in rows for value in row):
        known = np.asarray(rows, dtype)
        return known[0] if (known == known[0]).all() else row_at(known, chosen)
    # Of each row traced values first, then known ones as one constant; both are put in order after the choice.
    arrays, orders = [], []
    for row in rows:
        traced = [number for number, value in enumerate(row) if not _is_known(value)]
        known = [number for number, value in enumerate(row) if _is_known(value)]
        pieces = [jnp.stack([jnp.asarray(row[number], dtype) for number in traced])] if traced else []
        pieces += [np.asarray([row[number] for number in known], dtype)] if known else []
        arrays.append(jnp.concatenate(pieces))
        orders.append(np.argsort(traced + known))
    if len(rows) == 1:
        return row_at(arrays[0], orders[0])
    return row_at(row_at(jnp.stack(arrays), chosen), row_at(np.stack(orders), chosen))


def with_boxes(table: Table, parts: list[Part]) -> Table:
    """The table with boxes, each in its own row after those of the mechanism if it is active and the row exists."""
    return dataclasses.replace(table, boxes=_with_rows(table.boxes, table.num_boxes, parts))


def with_circle(table: Table, part: Part) -> Table:
    """The table with a circle in the row after those of the mechanism, if it is active."""
    return dataclasses.replace(table, circles=_with_rows(table.circles, table.num_circles, [part]))


def _with_rows(rows: Part, first: Array, parts: list[Part]) -> Part:
    offset = jnp.arange(np.shape(rows.active)[0]) - first
    is_active = functools.reduce(jnp.logical_or, [(offset == row) & part.active for row, part in enumerate(parts)])

    def with_column(name: str) -> Array:
        old = jnp.asarray(getattr(rows, name))
        values = [jnp.asarray(getattr(part, name), old.dtype) for part in parts]
        new = row_at(jnp.stack(values), jnp.clip(offset, 0, len(parts) - 1)) if len(parts) > 1 else values[0]
        return jnp.where(mask_like(is_active, old), new, old)

    names = [field.name for field in dataclasses.fields(rows) if getattr(rows, field.name) is not None]
    return dataclasses.replace(rows, **{name: with_column(name) for name in names})
