"""Canonical form of levels: two that look alike and move alike are equal, number by number, whatever their source.

    corners of a polygon   counter-clockwise, first the one with the smallest polar angle about the centroid, in
                           [0, 2 pi) and the shape's own frame: a box begins at (+, +)
    ends of a joint        a is the lower slot; polygons come before circles
    axis of a slider       an angle in [-pi, pi]; one within stays, bit for bit
    speed of a wheel       positive, as random and public levels have it (`turned_colours`)

A policy reads these numbers as they are stored: another order in a file, an importer or a generator would be a
difference to learn. `derive` brings every level into this form; every source of levels ends there. Slots are not
ordered: policies see shapes as a set. Everything here is pure and traceable.
"""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp

from jax2d.fields import Array
from jax2d.scene import JointDrive, JointKind, Joints
from jax2d.shapes import polygon_mass_properties
from kinetix_dist.level.level import NUM_MOTOR_COLOURS, Level, select_first

SEAM_TOLERANCE_RAD = 1e-4  # a corner at angle 0 is computed at up to some 1e-5 rad to either side of it in float32


def canonical(level: Level, is_fixed: Array) -> Level:
    """The same level (one, not a batch) in the form above. Corners must run counter-clockwise.

    is_fixed [n] bool: shapes that never move.
    """
    shapes, joints = level.scene.shapes, level.scene.joints
    num_polygons = shapes.num_vertices.shape[0]
    vertices = jax.vmap(canonical_corners)(jnp.asarray(shapes.vertices), jnp.asarray(shapes.num_vertices))
    is_polygon = jnp.asarray(shapes.active)[:num_polygons, None, None]
    ordered = in_order(joints)
    ordered = dataclasses.replace(ordered, axis_angle=_wrapped(ordered.axis_angle))
    scene = level.scene.replace(shapes={"vertices": jnp.where(is_polygon, vertices, shapes.vertices)}, joints=ordered)
    level = dataclasses.replace(level, scene=scene)
    return turn_round(level, turned_colours(level, is_fixed))


def turned_colours(level: Level, is_fixed: Array) -> Array:
    """`[4]` bool: motor colours that `canonical` turns round, of a level whose ends of joints are in order.

    A policy has to find out whether forward or backward leads to the goal, and a negative speed exchanges the two.
    Random levels have both signs between two polygons and about the hubs of arms, but every wheel of random and public
    levels has a positive speed: a policy that never saw a negative one drives it the wrong way. A wheel is a circle
    that moves and that a revolute joint with a motor that obeys the colour holds to a polygon. So where all wheels of a
    colour have negative speeds, all motors of the colour get the other sign: the same level, whose actions forward and
    backward of this colour have changed places.
    """
    joints = level.scene.joints
    num_polygons = level.scene.shapes.num_vertices.shape[0]
    obeys = _obeys(level)
    is_wheel = obeys & joints.is_kind(JointKind.REVOLUTE) & (joints.a < num_polygons) & (joints.b >= num_polygons)
    is_wheel = is_wheel & ~jnp.asarray(is_fixed)[joints.b]
    of_colour = jnp.asarray(level.motor_colour)[None, :] == jnp.arange(NUM_MOTOR_COLOURS)[:, None]  # [4, J]
    has_wheel = (of_colour & is_wheel).any(axis=1)
    other_way = (of_colour & is_wheel & (joints.motor_speed >= 0)).any(axis=1)
    other_drive = (of_colour & obeys & ~joints.is_drive(JointDrive.VELOCITY)).any(axis=1)
    return has_wheel & ~other_way & ~other_drive


def turn_round(level: Level, colours: Array) -> Level:
    """The level with the other sign of the speeds of all motors that obey these colours ([4] bool)."""
    joints = level.scene.joints
    is_turned = _obeys(level) & jnp.asarray(colours)[level.motor_colour]
    speed = jnp.where(is_turned, negative(joints.motor_speed), joints.motor_speed)
    return dataclasses.replace(level, scene=level.scene.replace(joints={"motor_speed": speed}))


def _obeys(level: Level) -> Array:
    """`[J]` bool: motors that follow the action of their colour."""
    joints = level.scene.joints
    return jnp.asarray(joints.active) & joints.motor_on & ~jnp.asarray(level.motor_auto)


def in_order(joints: Joints) -> Joints:
    """The same joints [J], end a the lower slot."""
    is_reversed = jnp.asarray(joints.active) & (jnp.asarray(joints.a) > jnp.asarray(joints.b))
    return select_first(is_reversed, swap_ends(joints), joints)


def canonical_corners(vertices: Array, num_vertices: Array) -> Array:
    """`[V, 2]` corners of one polygon in the order above; unused slots repeat the last corner.

    The frame's origin need not be the centroid.
    """
    slot = jnp.arange(vertices.shape[0])
    _, centroid, _ = polygon_mass_properties(vertices, num_vertices, 1.0)
    x, y = vertices[:, 0] - centroid[0], vertices[:, 1] - centroid[1]
    angle = jnp.arctan2(y, x)  # -pi to pi
    angle = jnp.where(angle < -SEAM_TOLERANCE_RAD, angle + 2.0 * math.pi, angle)
    first = jnp.argmin(jnp.where(slot < num_vertices, angle, jnp.inf))
    used = jnp.maximum(num_vertices, 1)
    return vertices[(first + jnp.minimum(slot, used - 1)) % used]


def swap_ends(joints: Joints) -> Joints:
    """The same joints (any leading axes) with a called b and b called a: they hold and drive as before.

    Angles of b against a become those of a against b. How far b has slid along the axis from a is how far a has slid
    from b along the opposite axis, so that of a slider only the axis changes, and the frame in which it is given.
    """
    slides = joints.is_kind(JointKind.PRISMATIC)
    return dataclasses.replace(
        with_opposite_angles(joints),
        a=joints.b,
        b=joints.a,
        anchor_a=joints.anchor_b,
        anchor_b=joints.anchor_a,
        axis_angle=jnp.where(slides, joints.axis_angle - joints.rest_angle + math.pi, joints.axis_angle),
    )


def with_opposite_angles(joints: Joints) -> Joints:
    """Angles of b against a with the other sign: rest angles, and speeds and limits of hinges."""
    slides = joints.is_kind(JointKind.PRISMATIC)
    return dataclasses.replace(
        joints,
        rest_angle=negative(joints.rest_angle),
        motor_speed=jnp.where(slides, joints.motor_speed, negative(joints.motor_speed)),
        lower_limit=jnp.where(slides, joints.lower_limit, negative(joints.upper_limit)),
        upper_limit=jnp.where(slides, joints.upper_limit, negative(joints.lower_limit)),
    )


def _wrapped(angle: Array) -> Array:
    """The same direction as an angle in [-pi, pi]."""
    return angle - 2.0 * math.pi * jnp.round(angle / (2.0 * math.pi))


def negative(x: Array) -> Array:
    """-x, and 0 of 0: a negative zero would be a different number in files."""
    return jnp.where(x == 0, 0, -jnp.asarray(x)).astype(jnp.asarray(x).dtype)
