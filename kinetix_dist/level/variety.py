"""Random levels with other physics: weak motors and thrusters, heavy and slippery shapes, motion, low gravity.

    generate_level -> vary, for a share `config.varied_share` of the levels

In the generator of the public package every wheel has the same power, every thruster more than the weight of its shape,
all shapes have one density and one friction, and nothing hangs on a wall. Levels drawn by people are more varied, and a
policy that has only seen the former acts as if all levels were so. Each of the changes below is made to half of the
varied levels. Positions do not change, so that nothing overlaps that did not. Pure, for one level; works inside jit
and vmap.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jax2d.scene import Array, JointKind
from kinetix_dist import prng
from kinetix_dist.level.derive import connections, derive
from kinetix_dist.level.level import NUM_WALLS, Level, Role

# Lowest and highest factor, by which all of a level's are multiplied; the logarithm of it is uniform.
MOTOR_POWER = (0.05, 2.0)
THRUSTER_POWER = (0.1, 1.5)
# The same, of each shape that moves.
DENSITY = (0.5, 4.0)
FRICTION = (0.1, 1.2)  # of each shape, uniform
GRAVITY = (0.2, 1.1)  # factor, uniform
VELOCITY_M_S = 1.5  # largest, along each axis, that all shapes of a body have at the start


def vary(key: Array, level: Level, share: float) -> Level:
    """The level, or, with that chance, one that differs in some of these. Consumes `key`."""
    original = level
    num_shapes = level.angle.shape[0]
    keys = prng.split(key, 4)
    coin, *coins = prng.uniform(keys[0], (10,))
    motor, thruster, heavy, rough, moving, pulled, held, red, hung = (each < 0.5 for each in coins)
    levelwide = prng.uniform(keys[1], (4,))
    wall = 1 + jnp.floor(levelwide[3] * (NUM_WALLS - 1)).astype(jnp.int32)  # not the floor, on which it could lie
    level = _either(hung, _hung_on_wall(level, wall), level)
    scene = level.scene
    shapes, joints, thrusters = scene.shapes, scene.joints, scene.thrusters
    of_shape = prng.uniform(keys[2], (2, num_shapes))
    exists = jnp.asarray(shapes.active)
    is_fixed = exists & (shapes.inverse_mass == 0)

    motor_power = joints.motor_power * jnp.where(motor, _log_uniform(levelwide[0], MOTOR_POWER), 1.0)
    thruster_power = thrusters.power * jnp.where(thruster, _log_uniform(levelwide[1], THRUSTER_POWER), 1.0)
    gravity = scene.gravity * jnp.where(pulled, _uniform(levelwide[2], GRAVITY), 1.0)
    density = shapes.density * jnp.where(heavy & exists & ~is_fixed, _log_uniform(of_shape[0], DENSITY), 1.0)
    friction = jnp.where(rough & exists, _uniform(of_shape[1], FRICTION), shapes.friction)

    # A goal that stays where it is, if green does not; shapes besides the floor that must not be touched.
    _, is_one_body = connections(joints.a, joints.b, joints.active, num_shapes)
    is_alone = (is_one_body.sum(axis=1) == 1) & ~_is_pushed(level)
    held = held & ~(is_fixed & (level.shape_role == Role.GREEN)).any()
    is_fixed = is_fixed | (held & exists & is_alone & (level.shape_role == Role.BLUE))
    is_spare = is_fixed & (level.shape_role == Role.NONE) & (jnp.arange(num_shapes) >= NUM_WALLS)
    role = jnp.where(red & is_spare, Role.RED, level.shape_role).astype(level.shape_role.dtype)

    # Shapes that are joined move as one, if they move.
    push = prng.uniform(keys[3], (num_shapes, 2), minval=-VELOCITY_M_S, maxval=VELOCITY_M_S)
    push = push[jnp.argmax(is_one_body, axis=1)]
    is_held = (is_one_body & is_fixed[None, :]).any(axis=1)
    velocity = level.velocity + jnp.where((moving & exists & ~is_held)[:, None], push, 0.0)

    changed = dataclasses.replace(
        level,
        scene=scene.replace(
            shapes={"density": density, "friction": friction},
            joints={"motor_power": motor_power},
            thrusters={"power": thruster_power},
            gravity=gravity,
        ),
        velocity=velocity,
        shape_role=role,
    )
    varied = derive(changed, is_fixed)
    return _either(coin < share, varied, original)


def _either(is_new: Array, new: Level, old: Level) -> Level:
    """One of two levels, which may have arrays in common."""
    return jax.tree.map(lambda a, b: b if a is b else jnp.where(is_new, a, b), new, old)


def _hung_on_wall(level: Level, wall: Array) -> Level:
    """The level with a fixed shape without a role removed and its joints held by a wall instead. The same level where
    there is no such shape."""
    scene = level.scene
    shapes, joints = scene.shapes, scene.joints
    slots, active = jnp.arange(level.angle.shape[0]), jnp.asarray(joints.active)
    is_end = [active[:, None] & (end[:, None] == slots) for end in (joints.a, joints.b)]  # [J, n]
    holds = jnp.asarray(shapes.active) & (shapes.inverse_mass == 0) & (slots >= NUM_WALLS)
    holds = holds & (level.shape_role == Role.NONE) & (is_end[0] | is_end[1]).any(axis=0) & ~_is_pushed(level)
    hub, has_hub = jnp.argmax(holds), holds.any()
    angle, cos, sin = level.angle[hub], jnp.cos(level.angle[hub]), jnp.sin(level.angle[hub])
    offset = level.position[hub] - level.position[wall]  # walls are level

    def of_wall(anchor: Array) -> Array:
        turned = [cos * anchor[:, 0] - sin * anchor[:, 1], sin * anchor[:, 0] + cos * anchor[:, 1]]
        return jnp.stack(turned, axis=-1) + offset

    by_a, by_b = (end[:, hub] & has_hub for end in is_end)
    hung = {
        "a": jnp.where(by_a, wall, joints.a),
        "b": jnp.where(by_b, wall, joints.b),
        "anchor_a": jnp.where(by_a[:, None], of_wall(joints.anchor_a), joints.anchor_a),
        "anchor_b": jnp.where(by_b[:, None], of_wall(joints.anchor_b), joints.anchor_b),
        "rest_angle": joints.rest_angle + jnp.where(by_a, angle, 0.0) - jnp.where(by_b, angle, 0.0),
        "axis_angle": joints.axis_angle + jnp.where(by_a & joints.is_kind(JointKind.PRISMATIC), angle, 0.0),
    }
    is_gone = has_hub & (slots == hub)
    return dataclasses.replace(
        level, scene=scene.replace(shapes={"active": jnp.asarray(shapes.active) & ~is_gone}, joints=hung)
    )


def _is_pushed(level: Level) -> Array:
    """[n] bool: shapes that have a thruster."""
    thrusters = level.scene.thrusters
    return jnp.zeros(level.angle.shape[0], bool).at[thrusters.body].max(jnp.asarray(thrusters.active))


def _uniform(draw: Array, limits: tuple[float, float]) -> Array:
    low, high = limits
    return low + (high - low) * draw


def _log_uniform(draw: Array, limits: tuple[float, float]) -> Array:
    low, high = limits
    return low * (high / low) ** draw
