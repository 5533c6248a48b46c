"""A level: a scene, how it starts, who plays which role and which action colour drives what.

Levels are data. One level has the shapes below; a batch has a leading axis on every field.
"""

from __future__ import annotations

import dataclasses

import jax

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
    """[J] bool, of a batch [W, J]: motors that do what the action of their colour says.

    The joint is there, is not fixed, has its motor on, and the motor does not run by itself.
    """
    joints = level.scene.joints
    return joints.active & joints.motor_on & ~joints.is_kind(JointKind.FIXED) & ~level.motor_auto
