"""A mechanism of a table written into a draft of a level: shapes, thrusters, and joints with their motors."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import Capacity, Thrusters
from kinetix_dist.level.draft import Draft, DrivenThrusters, Ends, MotorAndLimits, Shapes, joint_row, mask_like, row_at
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, NUM_WALLS
from kinetix_dist.level.mechanisms.table import Table
from kinetix_dist.level.mechanisms.template import Draws, between, number_between
from kinetix_dist.level.overlap import world_corners
from kinetix_dist.level.proposals import box_or_triangle

WEAK_SPEEDS, WEAK_POWERS = (0.5, 1.6), (0.2, 1.0)  # of motors, in units of a level


def with_table(draws: Draws, draft: Draft, table: Table, capacity: Capacity, config: GeneratorConfig) -> Draft:
    """The draft of nothing but walls with the mechanism: boxes in the first slots after the walls, circles, joints and
    thrusters in the first ones.

    Half of the time all motors are of one colour, else each of any, unless the mechanism requests something else.
    """
    shapes = _written(draft.shapes, _shape_rows(table, capacity), _of_slots(table, "active"))
    rows = table.thrusters
    thrusters = Thrusters(active=rows.active, body=rows.part, position=rows.at, angle=rows.angle, power=rows.power)
    driven = DrivenThrusters(thrusters=thrusters, colour=rows.colour)
    draft = dataclasses.replace(
        draft, shapes=shapes, driven_thrusters=_written(draft.driven_thrusters, driven, rows.active)
    )
    return _with_motors(draws, draft, table, capacity, config)


def _written(table: Any, rows: Any, active: Array) -> Any:
    """The table with the rows that are active ([n]); columns of `rows` may be one value for all."""
    return jax.tree.map(
        lambda old, new: jnp.where(mask_like(active, old), jnp.asarray(new, old.dtype), old), table, rows
    )


def _of_slots(table: Table, name: str) -> Array:
    """[n, ...] a column of boxes and circles, zeros for walls."""
    boxes, circles = getattr(table.boxes, name), getattr(table.circles, name)
    return jnp.concatenate([np.zeros((NUM_WALLS, *boxes.shape[1:]), boxes.dtype), boxes, circles])


def _shape_rows(table: Table, capacity: Capacity) -> Shapes:
    is_polygon = np.arange(capacity.shapes) < capacity.polygons
    half = jnp.pad(table.boxes.half_of_box, ((NUM_WALLS, capacity.circles), (0, 0)))[:, None]
    corners, _ = box_or_triangle(half, np.False_, capacity.vertices)
    return Shapes(
        active=_of_slots(table, "active"),
        position=_of_slots(table, "position"),
        angle=_of_slots(table, "angle"),
        vertices=corners,
        num_vertices=np.where(is_polygon, 4, 0),
        radius=jnp.pad(table.circles.radius_of_circle, (capacity.polygons, 0)),
        role=_of_slots(table, "role"),
        is_fixed=_of_slots(table, "is_fixed"),
        body=np.arange(capacity.shapes),
        num_joints=0,
        added_at=0,
    )


def _with_motors(draws: Draws, draft: Draft, table: Table, capacity: Capacity, config: GeneratorConfig) -> Draft:
    joints, task = table.joints, table.task
    number = np.shape(joints.active)[0]
    if not number:
        return draft
    one_colour = draws.chance(0.5)
    first = draws.number(0, NUM_MOTOR_COLOURS - 1)
    # The order of the draws determines the levels of a key.
    speed, power, colour = draws.rows(number, 3).T
    is_wheel = jnp.maximum(joints.a, joints.b) >= capacity.polygons
    lowest = jnp.where(task.has_weak_motors, WEAK_SPEEDS[0], config.motor_speed_min)
    speed = between(speed, lowest, jnp.where(task.has_weak_motors, WEAK_SPEEDS[1], config.motor_speed_max))
    strongest = jnp.where(is_wheel, config.wheel_power_max, config.motor_power_max)
    lowest = jnp.where(task.has_weak_motors, WEAK_POWERS[0], config.motor_power_min)
    power = between(power, lowest, jnp.where(task.has_weak_motors, WEAK_POWERS[1], strongest))
    colour = jnp.where(one_colour, first, number_between(colour, 0, NUM_MOTOR_COLOURS - 1))
    is_motor = jnp.asarray(joints.active & ~joints.is_weld)
    turn = joints.turn.or_else(jnp.cumsum(is_motor) - is_motor)  # or motors before it
    shapes, a, b = draft.shapes, joints.a, joints.b
    angle_a, angle_b = row_at(shapes.angle, a), row_at(shapes.angle, b)
    ends = Ends(
        a=a,
        b=b,
        anchor_a=_local(row_at(shapes.position, a), angle_a, joints.at),
        anchor_b=_local(row_at(shapes.position, b), angle_b, joints.at),
    )
    rest_angle = angle_b - angle_a
    hinge = MotorAndLimits(
        motor_on=joints.has_motor,
        speed=jnp.where(task.has_full_motors, config.motor_speed_max, speed),
        power=task.motor_power.or_else(jnp.where(task.has_full_motors, strongest, power)),
        has_limits=joints.limit.is_given,
        lower_limit=joints.bend - joints.limit.filled,
        upper_limit=joints.bend + joints.limit.filled,
        colour=jnp.where(task.colours_in_turn, (first + turn) % NUM_MOTOR_COLOURS, colour),
    )
    rows = joint_row(ends, joints.is_weld, rest_angle, hinge)
    # The active ones in the first slots, in their order.
    active = jnp.asarray(joints.active)
    slots = np.arange(capacity.joints)
    here = active & (jnp.cumsum(active) - 1 == slots[:, None])  # [J, H]
    source, is_written = jnp.argmax(here, axis=1), here.any(axis=1)
    rows = jax.tree.map(lambda column: _at_rows(column, number, source), rows)
    return dataclasses.replace(draft, driven_joints=_written(draft.driven_joints, rows, is_written))


def _at_rows(column: Any, number: int, rows: Array) -> Any:
    """Rows of a column; one value for all stays one value."""
    return row_at(column, rows) if np.ndim(column) and len(column) == number else column


def _local(position: Array, angle: Array, points: Array) -> Array:
    """[n, 2] m, points of the world in the frames of shapes, one each."""
    return world_corners(np.zeros(2, np.float32), -angle, (points - position)[:, None])[:, 0]
