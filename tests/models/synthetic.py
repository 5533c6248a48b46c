"""Random entity observations of any size, for tests of networks without an environment."""

from __future__ import annotations

import jax
import numpy as np

from jax2d.scene import Array, Capacity
from kinetix_dist.env.observations.entities import NUM_JOINT_FEATURES, EntityObs


def random_obs(num_worlds: int, capacity: Capacity, seed: int = 0) -> EntityObs:
    """Padded worlds: each slot exists with probability 0.7, polygon 0 always; masks symmetric and honest."""
    rng = np.random.default_rng(seed)
    num_shapes, num_joints = capacity.shapes, 2 * capacity.joints

    def features(count: int, width: int) -> Array:
        return rng.normal(size=(num_worlds, count, width)).astype(np.float32)

    shape_mask = rng.random((num_worlds, num_shapes)) < 0.7
    shape_mask[:, 0] = True
    relation = rng.random((num_worlds, 4, num_shapes, num_shapes)) < 0.4
    relation = relation | relation.swapaxes(2, 3) | np.eye(num_shapes, dtype=bool)
    relation[:, 0] = True
    obs = EntityObs(
        polygons=features(capacity.polygons, 19 + 2 * capacity.vertices),
        circles=features(capacity.circles, 19),
        joints=features(num_joints, NUM_JOINT_FEATURES),
        thrusters=features(capacity.thrusters, 8),
        shape_mask=shape_mask,
        joint_mask=rng.random((num_worlds, num_joints)) < 0.7,
        thruster_mask=rng.random((num_worlds, capacity.thrusters)) < 0.7,
        joint_from=rng.integers(0, num_shapes, (num_worlds, num_joints)).astype(np.int32),
        joint_to=rng.integers(0, num_shapes, (num_worlds, num_joints)).astype(np.int32),
        thruster_owner=rng.integers(0, num_shapes, (num_worlds, capacity.thrusters)).astype(np.int32),
        attention_masks=relation & shape_mask[:, None, :, None] & shape_mask[:, None, None, :],
    )
    return jax.tree.map(jax.numpy.asarray, obs)
