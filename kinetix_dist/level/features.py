"""Features of levels: counts of shapes, joints, motors, thrusters, fixed shapes and red shapes."""

from __future__ import annotations

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array, JointKind
from kinetix_dist.level.level import NUM_WALLS, Level, Role

# Order of the columns of `level_features`. Walls are no shapes here.
FEATURES = ("shapes", "joints", "motors", "thrusters", "fixed_shapes", "red_shapes")


def level_features(levels: Level) -> Array:
    """[W, len(FEATURES)] uint8 of a batch, of JAX or NumPy: NumPy levels give a NumPy array."""
    shapes, joints = levels.scene.shapes, levels.scene.joints
    return _counts(
        shape_active=shapes.active,
        inverse_mass=shapes.inverse_mass,
        shape_role=levels.shape_role,
        joint_active=joints.active,
        joint_kind=joints.kind,
        motor_on=joints.motor_on,
        thruster_active=levels.scene.thrusters.active,
    )


def features_of_arrays(levels: Mapping[str, np.ndarray]) -> np.ndarray:
    """The same features, of the arrays of levels by path, as a checkpoint has them."""
    num_levels = len(levels["position"])
    nothing = np.zeros((num_levels, 0), bool)  # checkpoints leave out arrays without elements
    return np.asarray(
        _counts(
            shape_active=levels["scene/shapes/active"],
            inverse_mass=levels["scene/shapes/inverse_mass"],
            shape_role=levels["shape_role"],
            joint_active=levels.get("scene/joints/active", nothing),
            joint_kind=levels.get("scene/joints/kind", nothing),
            motor_on=levels.get("scene/joints/motor_on", nothing),
            thruster_active=levels.get("scene/thrusters/active", nothing),
        )
    )


def _counts(
    *,
    shape_active: Array,
    inverse_mass: Array,
    shape_role: Array,
    joint_active: Array,
    joint_kind: Array,
    motor_on: Array,
    thruster_active: Array,
) -> Array:
    shape = shape_active[:, NUM_WALLS:]
    is_there = {
        "shapes": shape,
        "joints": joint_active,
        "motors": joint_active & motor_on & (joint_kind != JointKind.FIXED),
        "thrusters": thruster_active,
        "fixed_shapes": shape & (inverse_mass[:, NUM_WALLS:] == 0),
        "red_shapes": shape & (shape_role[:, NUM_WALLS:] == Role.RED),
    }
    stack = np.stack if isinstance(shape_active, np.ndarray) else jnp.stack
    return stack([is_there[name].sum(1) for name in FEATURES], axis=1).astype("uint8")
