"""How a level starts, as the engine's `State`."""

from __future__ import annotations

import numpy as np

from jax2d.scene import State
from kinetix_dist.level.level import Level


def start_state(level: Level) -> State:
    """The state of one level before its first step (numpy, no contacts remembered): to draw or to measure."""
    num_joints = np.shape(level.scene.joints.active)[0]
    return State(
        position=level.position,
        angle=level.angle,
        velocity=level.velocity,
        angular_velocity=level.angular_velocity,
        joint_impulse=np.zeros((num_joints, 5), np.float32),
        spring_impulse=np.zeros((0, 3), np.float32),
        contact_key=np.zeros(0, np.int32),
        contact_impulse=np.zeros((0, 2), np.float32),
        rolling_impulse=np.zeros(0, np.float32),
    )
