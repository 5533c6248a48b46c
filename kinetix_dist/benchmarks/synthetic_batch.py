"""Batches of observations that no level ever gave: real shapes and types, random numbers. For timing the learner.

Levels and rollouts would cost more than the gradient step that is timed, and change nothing about its time.
"""

from __future__ import annotations

import numpy as np

from jax2d.scene import Capacity
from kinetix_dist.env.action_spaces import MultiDiscrete
from kinetix_dist.env.observations.entities import (
    NUM_BODY_FEATURES,
    NUM_CIRCLE_FEATURES,
    NUM_JOINT_FEATURES,
    NUM_THRUSTER_FEATURES,
    DynamicObs,
    StaticObs,
    num_polygon_features,
)
from kinetix_dist.messages import Trajectory

ACTIONS = MultiDiscrete().distribution


def synthetic_static_obs(num_worlds: int, capacity: Capacity, seed: int = 0) -> StaticObs:
    """Observations of levels that were never built: right shapes, padded slots, random numbers."""
    rng = np.random.default_rng(seed)
    shapes, joints, words = capacity.shapes, 2 * capacity.joints, capacity.touch_words

    def features(count: int, width: int) -> np.ndarray:
        return rng.normal(size=(num_worlds, count, width)).astype(np.float32)

    shape_mask = rng.random((num_worlds, shapes)) < 0.8
    shape_mask[:, 0] = True
    active = (shape_mask * (1 << np.arange(shapes))).sum(axis=1).astype(np.uint32)
    rows = rng.integers(0, 2**shapes, (2, num_worlds, shapes)) & active[:, None]
    connected = (np.where(shape_mask, rows, 0) | (shape_mask * (1 << np.arange(shapes)))).astype(np.uint32)
    return StaticObs(
        polygons=features(capacity.polygons, num_polygon_features(capacity) - NUM_BODY_FEATURES),
        circles=features(capacity.circles, NUM_CIRCLE_FEATURES - NUM_BODY_FEATURES),
        joints=features(joints, NUM_JOINT_FEATURES),
        thrusters=features(capacity.thrusters, NUM_THRUSTER_FEATURES),
        shape_mask=shape_mask,
        joint_mask=rng.random((num_worlds, joints)) < 0.8,
        thruster_mask=rng.random((num_worlds, capacity.thrusters)) < 0.8,
        joint_from=rng.integers(0, shapes, (num_worlds, joints)).astype(np.int32),
        joint_to=rng.integers(0, shapes, (num_worlds, joints)).astype(np.int32),
        thruster_owner=rng.integers(0, shapes, (num_worlds, capacity.thrusters)).astype(np.int32),
        connected_any=np.repeat(connected[0][..., None], words, axis=-1),
        connected_one=np.repeat(connected[1][..., None], words, axis=-1),
    )


def synthetic_trajectory(num_steps: int, num_worlds: int, capacity: Capacity, seed: int = 0) -> Trajectory:
    """Trajectory of the levels of `synthetic_static_obs` as if they had been played, [steps, worlds, ...]."""
    rng = np.random.default_rng(seed)
    leading = (num_steps, num_worlds)
    return Trajectory(
        dynamic_obs=DynamicObs(
            bodies=rng.normal(size=(*leading, capacity.shapes, 7)).astype(np.float32),
            touching=rng.integers(
                0, 2**capacity.shapes, (*leading, capacity.shapes, capacity.touch_words), dtype=np.uint32
            ),
        ),
        actions=np.stack([rng.integers(0, size, leading) for size in ACTIONS.head_sizes], axis=-1).astype(
            ACTIONS.stored_dtype
        ),
        log_probs=rng.normal(-5.7, 0.1, leading).astype(np.float32),
        values=rng.normal(size=leading).astype(np.float32),
        rewards=rng.normal(size=leading).astype(np.float32),
        done_after=rng.random(leading) < 0.02,
    )
