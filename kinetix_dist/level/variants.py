"""Levels that differ a little from given ones: every other one in a mirror, with other gravity, masses and friction.

Geometry is that of the level, so that nothing overlaps that did not, and joints stay together. Variants are to develop
with: a policy that knows a level by heart is found out by its mirror image, and one that solves it by a hair by the
rest. Whether each variant can be solved is not proved; the changes are small.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.level.level import Level
from kinetix_dist.level.mirror import mirrored
from kinetix_dist.level.select import select_first
from kinetix_dist.level.varied_sets import variant_name

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
