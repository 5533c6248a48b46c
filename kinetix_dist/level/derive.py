"""Consequences of a level's geometry: centres of mass, masses, inertias, contact permissions and the canonical form.

Files, importers, the generator and mutators give shapes, joints and thrusters; these functions compute the rest and
bring corners and ends of joints into the order of `canonical.py`. Everything here is pure and traceable, for one level;
`jax.vmap` gives a batch.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from jax2d.shapes import circle_mass_properties, polygon_mass_properties
from kinetix_dist.level.canonical import canonical
from kinetix_dist.level.level import Level
from kinetix_dist.level.walls import COLLIDES_WITH_ALL

CENTRED_WITHIN_M = 2e-6  # float32 computes the centroid of walls of 10 m to some 1e-6 m


def touch_permissions(
    *,
    shape_active: Array,
    is_fixed: Array,
    collision_mode: Array,
    joint_active: Array,
    joint_a: Array,
    joint_b: Array,
) -> Array:
    """`[n, n]` bool: may shapes i and j collide?

    Not with themselves, not when inactive, not when both are fixed, not through mode 0 (unless the other is 2), and
    not within one body: shapes joined directly *or through others* never collide, as in the public levels (the two
    wheels of a car, the links of an arm).
    """
    _, connected = connections(joint_a, joint_b, joint_active, shape_active.shape[0])
    either_all = (collision_mode[:, None] == COLLIDES_WITH_ALL) | (collision_mode[None, :] == COLLIDES_WITH_ALL)
    both_solid = collision_mode[:, None] * collision_mode[None, :] > 0
    both_active = shape_active[:, None] & shape_active[None, :]
    both_fixed = is_fixed[:, None] & is_fixed[None, :]
    return both_active & ~both_fixed & (either_all | both_solid) & ~connected


def centre_on_mass(level: Level) -> Level:
    """Moves the origin of each polygon's frame to its area centroid; the world looks the same afterwards.

    Shifts position, vertices, joint anchors and thruster positions. Centred shapes stay as they are, bit for bit.
    """
    scene = level.scene
    num_polygons, num_circles = scene.shapes.num_vertices.shape[0], scene.shapes.radius.shape[0]
    _, centroid, _ = jax.vmap(polygon_mass_properties)(
        scene.shapes.vertices, scene.shapes.num_vertices, jnp.ones(num_polygons, jnp.float32)
    )
    is_centred = jnp.all(jnp.abs(centroid) < CENTRED_WITHIN_M, axis=-1, keepdims=True)
    centroid = jnp.where(is_centred, 0.0, centroid)
    shift = jnp.concatenate([centroid, jnp.zeros((num_circles, 2), jnp.float32)])  # [n, 2] m, body frame
    cos, sin = jnp.cos(level.angle), jnp.sin(level.angle)
    shift_world = jnp.stack([cos * shift[:, 0] - sin * shift[:, 1], sin * shift[:, 0] + cos * shift[:, 1]], axis=-1)
    moved = scene.replace(
        shapes={"vertices": scene.shapes.vertices - centroid[:, None, :]},
        joints={
            "anchor_a": scene.joints.anchor_a - shift[scene.joints.a],
            "anchor_b": scene.joints.anchor_b - shift[scene.joints.b],
        },
        thrusters={"position": scene.thrusters.position - shift[scene.thrusters.body]},
    )
    return dataclasses.replace(level, scene=moved, position=level.position + shift_world)


def derive(level: Level, is_fixed: Array) -> Level:
    """The level in canonical form, with inverse masses, inverse inertias and `can_touch` filled in.

    Vertices must be about the centre of mass. `is_fixed` [n] bool: shapes that never move, with zero inverse mass and
    inertia. Inactive shapes get zeros too.
    """
    level = canonical(level, is_fixed)
    scene = level.scene
    num_polygons = scene.shapes.num_vertices.shape[0]
    polygon_mass, _, polygon_inertia = jax.vmap(polygon_mass_properties)(
        scene.shapes.vertices, scene.shapes.num_vertices, scene.shapes.density[:num_polygons]
    )
    circle_mass, circle_inertia = circle_mass_properties(scene.shapes.radius, scene.shapes.density[num_polygons:])
    mass = jnp.concatenate([polygon_mass, circle_mass])
    inertia = jnp.concatenate([polygon_inertia, circle_inertia])
    moves = scene.shapes.active & ~is_fixed & (mass > 0.0)
    can_touch = touch_permissions(
        shape_active=scene.shapes.active,
        is_fixed=is_fixed,
        collision_mode=level.collision_mode,
        joint_active=scene.joints.active,
        joint_a=scene.joints.a,
        joint_b=scene.joints.b,
    )
    derived = scene.replace(
        shapes={
            "inverse_mass": jnp.where(moves, 1.0 / jnp.where(moves, mass, 1.0), 0.0),
            "inverse_inertia": jnp.where(moves, 1.0 / jnp.where(moves, inertia, 1.0), 0.0),
            "can_touch": can_touch,
        }
    )
    return dataclasses.replace(level, scene=derived)


@jax.jit
def _centre_and_derive(level: Level, is_fixed: Array) -> Level:
    # In canonical order before the centroid is computed, whose rounding depends on the first corner.
    return derive(centre_on_mass(canonical(level, is_fixed)), is_fixed)


def complete(level: Level, is_fixed: np.ndarray) -> Level:
    """`derive` on numpy arrays and about centres of mass, for levels that come from files or are built by hand."""
    return jax.tree.map(np.asarray, _centre_and_derive(level, is_fixed))


def connections(end_a: Array, end_b: Array, joint_active: Array, num_shapes: int) -> tuple[Array, Array]:
    """Shapes that one joint holds together, and that any number of joints do: two [..., n, n] bool, symmetric and True
    on the diagonal.

    end_a, end_b [..., J] int32: the shapes a joint holds; joint_active [..., J] bool.
    """
    index = jnp.arange(num_shapes)
    ends_a = (end_a[..., None] == index) & joint_active[..., None]
    ends_b = (end_b[..., None] == index) & joint_active[..., None]
    joined = (ends_a[..., :, None] & ends_b[..., None, :]).any(axis=-3)
    one = joined | jnp.swapaxes(joined, -1, -2) | jnp.eye(num_shapes, dtype=bool)
    any_number = one
    # Each squaring doubles the length of the chains followed; the longest has a joint between any two shapes.
    longest = min(joint_active.shape[-1], num_shapes - 1)
    for _ in range(max(longest - 1, 0).bit_length()):
        any_number = (any_number[..., :, :, None] & any_number[..., None, :, :]).any(axis=-2)
    return one, any_number
