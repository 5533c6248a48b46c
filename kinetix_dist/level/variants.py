"""Levels that differ a little from given ones: every other one in a mirror, with other gravity, masses and friction.

Geometry is that of the level, so that nothing overlaps that did not, and joints stay together. Variants are to develop
with: the mirror image reveals a policy that has memorised a level, the other changes one that solves it by a narrow
margin. It is not proved that each variant can be solved; the changes are small.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, JointKind
from kinetix_dist import prng
from kinetix_dist.level.canonical import canonical, negative, with_opposite_angles
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Level, select_first
from kinetix_dist.level.level_data import variant_name
from kinetix_dist.level.walls import WALL_NAMES

NUM_VARIANTS = 8  # of a level
# Largest changes, as shares; strength: of motors and thrusters.
GRAVITY, DENSITY, FRICTION, STRENGTH = 0.05, 0.1, 0.1, 0.05
VELOCITY_M_S = 0.1  # largest, along each axis, that all movable shapes have more at the start


def variants(key: Array, levels: Level, names: Sequence[str]) -> tuple[Level, list[str]]:
    """`NUM_VARIANTS` of each of W levels, [W NUM_VARIANTS, ...] (numpy), and their names. Consumes the key."""
    keys = jax.vmap(lambda number: prng.split(prng.fold_in(key, number), NUM_VARIANTS))(jnp.arange(len(names)))

    def of_one(keys: Array, level: Level) -> Level:
        varied = jax.vmap(_varied, in_axes=(0, None))(keys, level)
        image = jax.vmap(mirrored)(varied)
        is_image = np.arange(NUM_VARIANTS) % 2 == 1
        return select_first(is_image, image, varied)

    drawn = jax.device_get(jax.jit(jax.vmap(of_one))(keys, levels))
    flat = jax.tree.map(lambda x: x.reshape(x.shape[0] * NUM_VARIANTS, *x.shape[2:]), drawn)
    return flat, [variant_name(name, i) for name in names for i in range(NUM_VARIANTS)]


def _varied(key: Array, level: Level) -> Level:
    scene = level.scene
    shapes = scene.shapes
    keys = prng.split(key, 6)

    def factor(key: Array, change: float, like: Array) -> Array:
        return 1.0 + change * prng.uniform(key, jnp.shape(like), minval=-1.0, maxval=1.0)

    is_movable = jnp.asarray(shapes.active) & ((shapes.inverse_mass > 0) | (shapes.inverse_inertia > 0))
    density = jnp.where(is_movable, factor(keys[0], DENSITY, shapes.density), 1.0)
    push = VELOCITY_M_S * prng.uniform(keys[1], (2,), minval=-1.0, maxval=1.0)
    varied = scene.replace(
        shapes={
            "density": shapes.density * density,
            "inverse_mass": shapes.inverse_mass / density,
            "inverse_inertia": shapes.inverse_inertia / density,
            "friction": jnp.where(shapes.active, shapes.friction * factor(keys[2], FRICTION, shapes.friction), 1.0),
        },
        joints={"motor_power": scene.joints.motor_power * factor(keys[3], STRENGTH, scene.joints.motor_power)},
        thrusters={"power": scene.thrusters.power * factor(keys[4], STRENGTH, scene.thrusters.power)},
    )
    gravity = scene.gravity * (1.0 + GRAVITY * prng.uniform(keys[5], minval=-1.0, maxval=1.0))
    return dataclasses.replace(
        level,
        scene=dataclasses.replace(varied, gravity=gravity),
        velocity=level.velocity + jnp.where(is_movable[:, None], push, 0.0),
    )


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
    """The other side wall, of an end at one of them."""
    return jnp.where(end == _LEFT, _RIGHT, jnp.where(end == _RIGHT, _LEFT, end))
