"""What the actions of a level do: which motors and thrusters move something, for searches, editors and checks alike."""

from __future__ import annotations

import numpy as np

from jax2d.scene import JointKind
from kinetix_dist.level.level import Level


def motors_with_effect(level: Level) -> np.ndarray:
    """[J] bool: motors by which an action does something: those that obey one (`level.obeying_motors`), have power and
    hold something that can move. One of speed 0 among them can only brake."""
    joints, moves = level.scene.joints, _moves(level)
    obeys = np.asarray(joints.active) & np.asarray(joints.motor_on) & ~np.asarray(level.motor_auto)
    obeys &= ~np.asarray(joints.is_kind(JointKind.FIXED)) & (np.asarray(joints.motor_power) > 0)
    return obeys & (moves[np.asarray(joints.a)] | moves[np.asarray(joints.b)])


def driving_motors(level: Level) -> np.ndarray:
    """[J] bool: those with a speed, which an action makes move."""
    return motors_with_effect(level) & (np.asarray(level.scene.joints.motor_speed) != 0)


def pushing_thrusters(level: Level) -> np.ndarray:
    """[T] bool: thrusters that push something that can move."""
    thrusters = level.scene.thrusters
    pushes = np.asarray(thrusters.active) & (np.asarray(thrusters.power) != 0)
    return pushes & _moves(level)[np.asarray(thrusters.body)]


def _moves(level: Level) -> np.ndarray:
    return np.asarray(level.scene.shapes.inverse_mass) > 0
