"""A level seen in a mirror: left and right change places. The same actions do the same there, but that forward and
backward change places for colours of wheels: all turn the other way there, and `canonical` turns them round."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, JointKind
from kinetix_dist.level.canonical import canonical, negative, with_opposite_angles
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Level
from kinetix_dist.level.select import select_first
from kinetix_dist.level.walls import WALL_NAMES

_LEFT, _RIGHT = WALL_NAMES.index("left_wall"), WALL_NAMES.index("right_wall")


def mirrored(level: Level) -> Level:
    """One level, of numpy or JAX arrays; `jax.vmap` gives a batch. Walls keep their slots.

    Angles and spins change sign, and with them the speeds and limits of hinges; a slider's axis is turned round.
    """
    scene = level.scene
    shapes, joints, thrusters = scene.shapes, scene.joints, scene.thrusters
    is_mirrored = jnp.asarray(shapes.active) & (np.arange(shapes.active.shape[0]) >= NUM_WALLS)

    flip = jax.vmap(_flipped)
    num, slot = jnp.asarray(shapes.num_vertices)[:, None], jnp.arange(shapes.vertices.shape[1])
    backwards = jnp.where(slot < num, num - 1 - slot, 0)  # counter-clockwise again
    corners = jax.vmap(flip)(jnp.take_along_axis(jnp.asarray(shapes.vertices), backwards[..., None], axis=1))
    slides = joints.is_kind(JointKind.PRISMATIC)
    exists = jnp.asarray(joints.active)
    ends = [_other_wall(end) for end in (joints.a, joints.b)]
    mirrored_joints = dataclasses.replace(
        with_opposite_angles(joints),
        a=ends[0],
        b=ends[1],
        anchor_a=flip(joints.anchor_a),
        anchor_b=flip(joints.anchor_b),
        axis_angle=jnp.where(slides, np.pi - joints.axis_angle, joints.axis_angle),
    )
    pushes = jnp.asarray(thrusters.active)
    mirrored_scene = scene.replace(
        shapes={"vertices": select_first(is_mirrored[: corners.shape[0]], corners, shapes.vertices)},
        joints=select_first(exists, mirrored_joints, joints),
        thrusters={
            "position": select_first(pushes, flip(thrusters.position), thrusters.position),
            "angle": select_first(pushes, np.pi - thrusters.angle, thrusters.angle),
        },
    )
    position = jnp.stack([WORLD_SIZE_M - level.position[:, 0], level.position[:, 1]], axis=-1)
    is_fixed = jnp.asarray(shapes.active) & (shapes.inverse_mass == 0)
    return canonical(
        dataclasses.replace(
            level,
            scene=dataclasses.replace(mirrored_scene, gravity=_flipped(scene.gravity)),
            position=select_first(is_mirrored, position, level.position),
            angle=select_first(is_mirrored, negative(level.angle), level.angle),
            velocity=select_first(is_mirrored, flip(level.velocity), level.velocity),
            angular_velocity=select_first(is_mirrored, negative(level.angular_velocity), level.angular_velocity),
        ),
        is_fixed,
    )


def _flipped(point: Array) -> Array:
    return jnp.stack([negative(point[0]), point[1]])


def _other_wall(end: Array) -> Array:
    """What is held by the left wall is held by the right one."""
    return jnp.where(end == _LEFT, _RIGHT, jnp.where(end == _RIGHT, _LEFT, end))
