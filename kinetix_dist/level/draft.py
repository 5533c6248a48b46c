"""A level being drawn: its shapes, joints and thrusters so far, additions to it, and its slots in random order.

Arrays have the final capacity. Writes go to a traced slot through a mask, which under `vmap` is a select instead of
a scatter. Masses and contact permissions are left to `derive`, once, at the end.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array, replace
from jax2d.scene import Capacity, JointDrive, JointKind, Joints, Thrusters
from kinetix_dist.level.level import NUM_WALLS, Level, Role
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
class DrivenJoints:
    """`J` joints and the colours that drive them."""

    joints: Joints
    colour: Array  # [J] int32


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ends:
    """The two shapes that a joint holds; left open where the caller fills them in later."""

    a: Array | int = 0  # slots
    b: Array | int = 0
    anchor_a: Array | None = None  # [2] m, frame of a
    anchor_b: Array | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class MotorAndLimits:
    """Motor and limits of a hinge; a weld has neither."""

    motor_on: Array
    speed: Array
    power: Array
    colour: Array
    has_limits: Array
    lower_limit: Array  # rad
    upper_limit: Array


def joint_row(ends: Ends, is_weld: Array, rest_angle: Array, hinge: MotorAndLimits) -> DrivenJoints:
    """One active joint, a hinge or a weld, without the leading axis. Limits that a joint does not have are zeros."""
    has_limits = hinge.has_limits & ~is_weld
    joint = Joints(
        active=jnp.array(True),
        kind=jnp.where(is_weld, JointKind.FIXED, JointKind.REVOLUTE),
        a=jnp.asarray(ends.a),
        b=jnp.asarray(ends.b),
        anchor_a=jnp.zeros(2, jnp.float32) if ends.anchor_a is None else ends.anchor_a,
        anchor_b=jnp.zeros(2, jnp.float32) if ends.anchor_b is None else ends.anchor_b,
        rest_angle=rest_angle,
        axis_angle=jnp.zeros((), jnp.float32),
        motor_on=hinge.motor_on & ~is_weld,
        drive=jnp.array(JointDrive.VELOCITY, jnp.int32),
        motor_speed=jnp.where(is_weld, 0.0, hinge.speed),
        motor_power=jnp.where(is_weld, 0.0, hinge.power),
        has_limits=has_limits,
        lower_limit=jnp.where(has_limits, hinge.lower_limit, 0.0),
        upper_limit=jnp.where(has_limits, hinge.upper_limit, 0.0),
    )
    return DrivenJoints(joints=joint, colour=hinge.colour)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class DrivenThrusters:
    """`T` thrusters and the colours that drive them."""

    thrusters: Thrusters
    colour: Array  # [T] int32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Draft:
    """Shapes, joints and thrusters drawn so far."""

    shapes: Shapes
    driven_joints: DrivenJoints
    driven_thrusters: DrivenThrusters

    @property
    def joints(self) -> Joints:
        return self.driven_joints.joints

    @property
    def thrusters(self) -> Thrusters:
        return self.driven_thrusters.thrusters


def empty_draft(capacity: Capacity) -> Draft:
    """The four walls."""
    level = empty_level(capacity)
    scene = level.scene
    n, num_circles = capacity.shapes, capacity.circles
    is_wall = np.asarray(scene.shapes.active)
    corners = np.concatenate([scene.shapes.vertices, np.zeros((num_circles, capacity.vertices, 2), np.float32)])
    shapes = Shapes(
        active=is_wall,
        position=level.position,
        angle=level.angle,
        vertices=corners,
        num_vertices=np.concatenate([scene.shapes.num_vertices, np.zeros(num_circles, np.int32)]),
        radius=np.concatenate([np.zeros(capacity.polygons, np.float32), scene.shapes.radius]),
        role=level.shape_role,
        is_fixed=is_wall,
        body=np.arange(n, dtype=np.int32),
        num_joints=np.zeros(n, np.int32),
        added_at=np.full(n, -1, np.int32),
    )
    draft = Draft(
        shapes=shapes,
        driven_joints=DrivenJoints(joints=scene.joints, colour=level.motor_colour),
        driven_thrusters=DrivenThrusters(thrusters=scene.thrusters, colour=level.thruster_colour),
    )
    return jax.tree.map(jnp.asarray, draft)


def with_green_and_blue_exchanged(draft: Draft, is_wanted: Array) -> Draft:
    """The draft with the roles of green and blue shapes exchanged, where that is wanted."""
    role = draft.shapes.role
    is_either = (role == Role.GREEN) | (role == Role.BLUE)
    role = jnp.where(is_wanted & is_either, Role.GREEN + Role.BLUE - role, role)
    return dataclasses.replace(draft, shapes=dataclasses.replace(draft.shapes, role=role))


def write_slot(table: Any, slot: Array, row: Any, do: Array) -> Any:
    """`table` with row number `slot` replaced where `do`; both are pytrees of one kind."""
    here = (jnp.arange(len(jax.tree.leaves(table)[0])) == slot) & do

    def write(column: Array, value: Array) -> Array:
        return jnp.where(mask_like(here, column), jnp.asarray(value, column.dtype), column)

    return jax.tree.map(write, table, row)


def read_slot(table: Any, slot: Array) -> Any:
    """Row number `slot` of every column."""
    return jax.tree.map(lambda column: row_at(column, slot), table)


def row_at(column: Array, slot: Array) -> Array:
    """A row of a column, or several, which must be there: one equation, where `column[slot]` is six."""
    return jnp.asarray(column).at[slot].get(mode="promise_in_bounds", wrap_negative_indices=False)


def mask_like(mask: Array, column: Array) -> Array:
    """The mask ([n]) with as many axes as the column ([n, ...])."""
    return mask.reshape(mask.shape + (1,) * (column.ndim - 1))


def first_free(active: Array) -> Array:
    """Index of the first inactive slot (0 where there is none: check `~active.all()` too)."""
    return jnp.argmin(active)


def draft_to_level(draft: Draft, capacity: Capacity) -> tuple[Level, Array]:
    """The level (masses and contact permissions still to be derived) and `is_fixed` [n]."""
    blank = jax.tree.map(jnp.asarray, empty_level(capacity))
    return with_draft(blank, draft, capacity), draft.shapes.is_fixed


def with_draft(level: Level, draft: Draft, capacity: Capacity) -> Level:
    """The level with the shapes, joints and thrusters of a draft, and its own gravity, speeds and surfaces. Masses are
    still to be derived."""
    shapes, polygons = draft.shapes, capacity.polygons
    scene = level.scene.replace(
        shapes={
            "active": shapes.active,
            "vertices": shapes.vertices[:polygons],
            "num_vertices": shapes.num_vertices[:polygons],
            "radius": shapes.radius[polygons:],
        },
        joints=draft.joints,
        thrusters=draft.thrusters,
    )
    return dataclasses.replace(
        level,
        scene=scene,
        position=shapes.position,
        angle=shapes.angle,
        shape_role=shapes.role,
        motor_colour=draft.driven_joints.colour,
        thruster_colour=draft.driven_thrusters.colour,
    )


def permute_slots(draw: Array, draft: Draft, num_polygons: int) -> Draft:
    """The same draft with polygons (walls excepted), circles, joints and thrusters in other slots each.

    `draw` holds `num_permutation_draws(draft)` uniform numbers. `body` and `added_at` move along but keep their
    values: they are notes of the generator, not slot numbers.
    """
    num_shapes = draft.shapes.active.shape[0]
    num_joints, num_thrusters = draft.joints.active.shape[0], draft.thrusters.active.shape[0]
    ends = np.cumsum([num_polygons - NUM_WALLS, num_shapes - num_polygons, num_joints, num_thrusters])
    by_draw = [jnp.argsort(part) for part in jnp.split(draw, ends[:-1])]
    walls = jnp.arange(NUM_WALLS)
    polygons = NUM_WALLS + by_draw[0]
    circles = num_polygons + by_draw[1]
    source = jnp.concatenate([walls, polygons, circles])  # new slot -> old slot
    slot_of = jnp.argsort(source).astype(jnp.int32)  # old slot -> new slot
    joint_order = by_draw[2]
    thruster_order = by_draw[3]
    shapes = jax.tree.map(lambda x: row_at(x, source), draft.shapes)
    joints = jax.tree.map(lambda x: row_at(x, joint_order), draft.driven_joints)
    thrusters = jax.tree.map(lambda x: row_at(x, thruster_order), draft.driven_thrusters)
    return Draft(
        shapes=shapes,
        driven_joints=replace(
            joints, joints={"a": row_at(slot_of, joints.joints.a), "b": row_at(slot_of, joints.joints.b)}
        ),
        driven_thrusters=replace(thrusters, thrusters={"body": row_at(slot_of, thrusters.thrusters.body)}),
    )


def num_permutation_draws(draft: Draft) -> int:
    """Number of uniform numbers that `permute_slots` uses."""
    counts = (draft.shapes.active, draft.joints.active, draft.thrusters.active)
    return sum(active.shape[0] for active in counts) - NUM_WALLS
