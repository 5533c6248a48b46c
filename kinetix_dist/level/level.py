"""A level: a scene, its state at the start, the roles of shapes, and the colours of motors and thrusters.

Levels are data. One level has the shapes below; a batch has a leading axis on every field.
"""

from __future__ import annotations

import dataclasses
import enum
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array, array, part
from jax2d.scene import Capacity, JointKind, Scene

NUM_MOTOR_COLOURS = 4
NUM_THRUSTER_COLOURS = 2
NUM_WALLS = 4  # polygons 0-3 of every level: floor, left wall, right wall, ceiling
WORLD_SIZE_M = 5.0  # levels are played in a 5 x 5 m box, origin at the lower left corner

SIZES: dict[str, Capacity] = {
    "s": Capacity(polygons=5, circles=2, joints=1, thrusters=1),
    "m": Capacity(polygons=6, circles=3, joints=2, thrusters=2),
    "l": Capacity(polygons=12, circles=4, joints=6, thrusters=2),
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Level:
    """One level of `n` shapes, `J` joints, `T` thrusters (or a batch, with a leading axis)."""

    scene: Scene = part(Scene)
    position: Array = array("n 2", float, "centre of mass at the start", unit="m")
    angle: Array = array("n", float, "at the start", unit="rad")
    velocity: Array = array("n 2", float, "at the start", unit="m/s")
    angular_velocity: Array = array("n", float, "at the start", unit="rad/s")
    shape_role: Array = array("n", int, "Role")
    collision_mode: Array = array("n", int, "0 passes through 1s, 1 normal, 2 touches all (walls)", empty=1)
    motor_colour: Array = array("J", int, "0..NUM_MOTOR_COLOURS-1")
    motor_auto: Array = array("J", bool, "always runs forward whatever the action")
    thruster_colour: Array = array("T", int, "0..NUM_THRUSTER_COLOURS-1")


def obeying_motors(level: Level) -> Array:
    """[J] bool, of a batch [W, J]: motors that follow the action of their colour.

    The joint is there, is not fixed, has its motor on, and the motor does not run by itself.
    """
    joints = level.scene.joints
    return joints.active & joints.motor_on & ~joints.is_kind(JointKind.FIXED) & ~level.motor_auto


class Role(enum.IntEnum):
    """Role of a shape; the numbers are those of the public Kinetix level files."""

    NONE = 0
    GREEN = 1
    BLUE = 2  # the goal
    RED = 3  # touching it with green ends the episode with -1


ROLE_NAMES = tuple(role.name.lower() for role in Role)  # as level files spell them


def motors_with_effect(level: Level) -> np.ndarray:
    """[J] bool: motors with an effect: they obey an action (`obeying_motors`), have power and hold a shape that can
    move. One of speed 0 can only brake."""
    joints, moves = level.scene.joints, _moves(level)
    obeys = np.asarray(joints.active) & np.asarray(joints.motor_on) & ~np.asarray(level.motor_auto)
    obeys &= ~np.asarray(joints.is_kind(JointKind.FIXED)) & (np.asarray(joints.motor_power) > 0)
    return obeys & (moves[np.asarray(joints.a)] | moves[np.asarray(joints.b)])


def driving_motors(level: Level) -> np.ndarray:
    """[J] bool: motors with an effect and a speed."""
    return motors_with_effect(level) & (np.asarray(level.scene.joints.motor_speed) != 0)


def pushing_thrusters(level: Level) -> np.ndarray:
    """[T] bool: thrusters with power on a shape that can move."""
    thrusters = level.scene.thrusters
    pushes = np.asarray(thrusters.active) & (np.asarray(thrusters.power) != 0)
    return pushes & _moves(level)[np.asarray(thrusters.body)]


def _moves(level: Level) -> np.ndarray:
    return np.asarray(level.scene.shapes.inverse_mass) > 0


def select_first(mask: Array, new: Any, old: Any) -> Any:
    """`new` where mask [N], else `old`, of two trees of arrays [N, ...], row by row."""

    def select(a: Array, b: Array) -> Array:
        return jnp.where(jnp.reshape(mask, (-1, *[1] * (jnp.ndim(b) - 1))), a, b)

    return jax.tree.map(select, new, old)
