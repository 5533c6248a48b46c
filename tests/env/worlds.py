"""Hand-built levels of size S for the tests of environment and evaluation: walls, one box, two discs."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jax2d.fields import empty, with_fields
from jax2d.scene import Scene, stack_worlds
from kinetix_dist.level.level import SIZES, WORLD_SIZE_M, Level, Role

BOX, DISC_1, DISC_2 = 4, 5, 6  # shape indices in a level of size S
HALF_BOX_M = 0.25
RADIUS_M = 0.25


def small_level(
    *,
    box: tuple[float, float] = (1.0, 1.0),
    disc_1: tuple[float, float] = (3.0, 1.0),
    disc_2: tuple[float, float] | None = None,
    roles: dict[int, Role] | None = None,
    fixed: tuple[int, ...] = (),
    gravity: float = 0.0,
    velocity: dict[int, tuple[float, float]] | None = None,
    joint: dict[str, Any] | None = None,
    thruster: dict[str, Any] | None = None,
) -> Level:
    """One level of size S. `disc_2` is absent unless placed; `joint`, `thruster` give fields of `Level` and `Scene`."""
    capacity = SIZES["s"]
    n, reach = capacity.shapes, WORLD_SIZE_M
    active = np.ones(n, bool)
    active[DISC_2] = disc_2 is not None
    is_fixed = np.isin(np.arange(n), (0, 1, 2, 3, *fixed)) | ~active
    box_mass, disc_mass = (2 * HALF_BOX_M) ** 2, np.pi * RADIUS_M**2
    mass = np.array([1, 1, 1, 1, box_mass, disc_mass, disc_mass])
    inertia = np.array([1, 1, 1, 1, box_mass * (2 * HALF_BOX_M) ** 2 / 6, *[disc_mass * RADIUS_M**2 / 2] * 2])
    wall = reach / 2
    can_touch = active[:, None] & active[None, :] & ~np.eye(n, dtype=bool)
    can_touch &= ~(is_fixed[:, None] & is_fixed[None, :]) | (np.arange(n)[:, None] >= 4) & (np.arange(n) >= 4)
    fields: dict[str, Any] = {
        "shapes.active": active,
        "shapes.inverse_mass": np.where(is_fixed, 0, 1 / mass).astype(np.float32),
        "shapes.inverse_inertia": np.where(is_fixed, 0, 1 / inertia).astype(np.float32),
        "shapes.density": np.ones(n, np.float32),
        "shapes.friction": np.full(n, 0.5, np.float32),
        "shapes.restitution": np.zeros(n, np.float32),
        "shapes.vertices": np.stack([rectangle(wall, wall)] * 4 + [rectangle(HALF_BOX_M, HALF_BOX_M)]),
        "shapes.num_vertices": np.full(5, 4, np.int32),
        "shapes.radius": np.full(2, RADIUS_M, np.float32),
        "shapes.can_touch": can_touch,
        "joints.active": np.zeros(1, bool),
        "joints.a": np.zeros(1, np.int32),
        "joints.b": np.zeros(1, np.int32),
        "joints.anchor_a": np.zeros((1, 2), np.float32),
        "joints.anchor_b": np.zeros((1, 2), np.float32),
        "joints.kind": np.zeros(1, np.int32),
        "joints.rest_angle": np.zeros(1, np.float32),
        "joints.axis_angle": np.zeros(1, np.float32),
        "joints.motor_on": np.zeros(1, bool),
        "joints.drive": np.zeros(1, np.int32),
        "joints.motor_speed": np.zeros(1, np.float32),
        "joints.motor_power": np.zeros(1, np.float32),
        "joints.has_limits": np.zeros(1, bool),
        "joints.lower_limit": np.zeros(1, np.float32),
        "joints.upper_limit": np.zeros(1, np.float32),
        "thrusters.active": np.zeros(1, bool),
        "thrusters.body": np.zeros(1, np.int32),
        "thrusters.position": np.zeros((1, 2), np.float32),
        "thrusters.angle": np.zeros(1, np.float32),
        "thrusters.power": np.zeros(1, np.float32),
        "gravity": np.array([0.0, gravity], np.float32),
    }
    extra = {"motor_colour": np.zeros(1, np.int32), "motor_auto": np.zeros(1, bool)}
    extra["thruster_colour"] = np.zeros(1, np.int32)
    for name, value in {**(joint or {}), **(thruster or {})}.items():
        target = fields if name in fields else extra
        target[name] = np.asarray([value], target[name].dtype)
    if fields["joints.active"][0]:
        a, b = fields["joints.a"][0], fields["joints.b"][0]
        can_touch[a, b] = can_touch[b, a] = False
    shape_role = np.zeros(n, np.int32)
    for shape, role in (roles or {BOX: Role.GREEN, DISC_1: Role.BLUE}).items():
        shape_role[shape] = role
    position = np.zeros((n, 2), np.float32)
    position[:4] = [(wall, -wall), (-wall, wall), (reach + wall, wall), (wall, reach + wall)]
    position[4:] = [box, disc_1, disc_2 or (0.0, 0.0)]
    speed = np.zeros((n, 2), np.float32)
    for shape, value in (velocity or {}).items():
        speed[shape] = value
    return Level(
        scene=with_fields(empty(Scene, SIZES["s"].sizes), fields),
        position=position,
        angle=np.zeros(n, np.float32),
        velocity=speed,
        angular_velocity=np.zeros(n, np.float32),
        shape_role=shape_role,
        collision_mode=np.array([2, 2, 2, 2, 1, 1, 1], np.int32),
        **extra,
    )


def rectangle(half_width: float, half_height: float) -> np.ndarray:
    """[4, 2] m, counter-clockwise about the centre."""
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    return np.array([(x * half_width, y * half_height) for x, y in corners], np.float32)


def batch(*levels: Level) -> Level:
    """Levels with a leading world axis, as jax arrays."""
    return jax.tree.map(jax.numpy.asarray, stack_worlds(list(levels)))


MOTOR_JOINT = {
    "joints.active": True,
    "joints.a": BOX,
    "joints.b": DISC_1,
    "joints.anchor_a": (0.5, 0.1),
    "joints.anchor_b": (-0.2, 0.3),
    "joints.motor_on": True,
    "joints.motor_speed": 1.5,
    "joints.motor_power": 2.0,
    "motor_colour": 2,
}
THRUSTER = {
    "thrusters.active": True,
    "thrusters.body": BOX,
    "thrusters.position": (0.1, -0.2),
    "thrusters.angle": np.pi / 2,
    "thrusters.power": 2.0,
    "thruster_colour": 1,
}
