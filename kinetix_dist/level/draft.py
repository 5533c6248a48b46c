"""A level being drawn: what exists so far, and adding one candidate to it.

Arrays have the final capacity. Writes go to a traced slot through a mask, which under `vmap` is a select instead of
a scatter. Masses and contact permissions are left to `derive`, once, at the end.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, Capacity
from kinetix_dist.level.level import Level
from kinetix_dist.level.walls import empty_level


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Shapes:
    """`n` shapes, polygons first (one shape without the leading axis, in a candidate)."""

    active: Array  # [n] bool
    position: Array  # [n, 2] m, world frame
    angle: Array  # [n] rad
    vertices: Array  # [n, V, 2] m, about the centroid, counter-clockwise; zeros for circles
    num_vertices: Array  # [n] int32, 0 for circles
    radius: Array  # [n] m, 0 for polygons
    role: Array  # [n] int32
    is_fixed: Array  # [n] bool
    body: Array  # [n] int32, shapes joined to one another have one number: they never collide
    num_joints: Array  # [n] int32
    added_at: Array  # [n] int32, when it was added (walls -1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Joints:
    """`J` joints; fields mean what those of `Scene` mean."""

    active: Array  # [J] bool
    a: Array  # [J] int32
    b: Array  # [J] int32
    anchor_a: Array  # [J, 2] m
    anchor_b: Array  # [J, 2] m
    is_fixed: Array  # [J] bool
    rest_angle: Array  # [J] rad
    motor_on: Array  # [J] bool
    motor_speed: Array  # [J]
    motor_power: Array  # [J]
    has_limits: Array  # [J] bool
    lower: Array  # [J] rad
    upper: Array  # [J] rad
    colour: Array  # [J] int32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Thrusters:
    """`T` thrusters."""

    active: Array  # [T] bool
    body: Array  # [T] int32
    position: Array  # [T, 2] m
    angle: Array  # [T] rad
    power: Array  # [T]
    colour: Array  # [T] int32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Draft:
    """What has been drawn so far."""

    shapes: Shapes
    joints: Joints
    thrusters: Thrusters


def empty_draft(capacity: Capacity) -> Draft:
    """The four walls."""
    level = empty_level(capacity)
    scene = level.scene
    n, num_circles = capacity.shapes, capacity.circles
    is_wall = np.asarray(scene.shape_active)
    corners = np.concatenate([scene.vertices, np.zeros((num_circles, capacity.vertices, 2), np.float32)])
    shapes = Shapes(
        active=is_wall,
        position=level.position,
        angle=level.angle,
        vertices=corners,
        num_vertices=np.concatenate([scene.num_vertices, np.zeros(num_circles, np.int32)]),
        radius=np.concatenate([np.zeros(capacity.polygons, np.float32), scene.radius]),
        role=level.shape_role,
        is_fixed=is_wall,
        body=np.arange(n, dtype=np.int32),
        num_joints=np.zeros(n, np.int32),
        added_at=np.full(n, -1, np.int32),
    )
    joints = Joints(
        active=scene.joint_active,
        a=scene.joint_a,
        b=scene.joint_b,
        anchor_a=scene.joint_anchor_a,
        anchor_b=scene.joint_anchor_b,
        is_fixed=scene.joint_is_fixed,
        rest_angle=scene.joint_rest_angle,
        motor_on=scene.motor_on,
        motor_speed=scene.motor_speed,
        motor_power=scene.motor_power,
        has_limits=scene.has_limits,
        lower=scene.lower_limit,
        upper=scene.upper_limit,
        colour=level.motor_colour,
    )
    thrusters = Thrusters(
        active=scene.thruster_active,
        body=scene.thruster_body,
        position=scene.thruster_position,
        angle=scene.thruster_angle,
        power=scene.thruster_power,
        colour=level.thruster_colour,
    )
    return jax.tree.map(jnp.asarray, Draft(shapes=shapes, joints=joints, thrusters=thrusters))


def write_slot(table: Any, slot: Array, row: Any, do: Array) -> Any:
    """`table` with row number `slot` replaced where `do`; both are pytrees of one kind."""

    def write(column: Array, value: Array) -> Array:
        here = (jnp.arange(column.shape[0]) == slot) & do
        here = here.reshape(here.shape + (1,) * (column.ndim - 1))
        return jnp.where(here, jnp.asarray(value, column.dtype), column)

    return jax.tree.map(write, table, row)


def read_slot(table: Any, slot: Array) -> Any:
    """Row number `slot` of every column."""
    return jax.tree.map(lambda column: column[slot], table)


def first_free(active: Array) -> Array:
    """Index of the first inactive slot (0 where there is none: ask `~active.all()` too)."""
    return jnp.argmin(active)


def draft_to_level(draft: Draft, capacity: Capacity) -> tuple[Level, Array]:
    """The level (masses and contact permissions still to be derived) and `is_fixed` [n]."""
    shapes, joints, thrusters = draft.shapes, draft.joints, draft.thrusters
    blank = jax.tree.map(jnp.asarray, empty_level(capacity))
    polygons = capacity.polygons
    scene = dataclasses.replace(
        blank.scene,
        shape_active=shapes.active,
        vertices=shapes.vertices[:polygons],
        num_vertices=shapes.num_vertices[:polygons],
        radius=shapes.radius[polygons:],
        joint_active=joints.active,
        joint_a=joints.a,
        joint_b=joints.b,
        joint_anchor_a=joints.anchor_a,
        joint_anchor_b=joints.anchor_b,
        joint_is_fixed=joints.is_fixed,
        joint_rest_angle=joints.rest_angle,
        motor_on=joints.motor_on,
        motor_speed=joints.motor_speed,
        motor_power=joints.motor_power,
        has_limits=joints.has_limits,
        lower_limit=joints.lower,
        upper_limit=joints.upper,
        thruster_active=thrusters.active,
        thruster_body=thrusters.body,
        thruster_position=thrusters.position,
        thruster_angle=thrusters.angle,
        thruster_power=thrusters.power,
    )
    level = dataclasses.replace(
        blank,
        scene=scene,
        position=shapes.position,
        angle=shapes.angle,
        shape_role=shapes.role,
        motor_colour=joints.colour,
        thruster_colour=thrusters.colour,
    )
    return level, shapes.is_fixed
