"""Flat observations: the entity observation as one vector, for policies that are plain multilayer perceptrons.

    [polygons P x 27 | circles C x 19 | joints J x 25 | thrusters T x 8 | joint ends J x 2 n | thruster owners T x n]

Each joint appears once (as seen from a). Ends and owners are one-hot over shapes, since a vector has no indices.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array, Capacity
from kinetix_dist.env.observations.entities import (
    NUM_CIRCLE_FEATURES,
    NUM_JOINT_FEATURES,
    NUM_THRUSTER_FEATURES,
    DynamicObs,
    EntityObs,
    EntityObservation,
    StaticObs,
    num_polygon_features,
)
from kinetix_dist.env.observations.observation import VECTOR


class FlatObservation(EntityObservation):
    """Stored as the entity observation, of which it has the numbers."""

    gives = VECTOR

    def join(self, static: StaticObs, dynamic: DynamicObs) -> Array:
        return flatten(super().join(static, dynamic))


def flatten(obs: EntityObs) -> Array:
    """[..., flat_size(capacity)] float32."""
    num_shapes = obs.shape_mask.shape[-1]
    num_joints = obs.joints.shape[-2] // 2
    is_joint = obs.joint_mask[..., :num_joints, None]
    ends_from = jax.nn.one_hot(obs.joint_from[..., :num_joints], num_shapes, dtype=jnp.float32) * is_joint
    ends_to = jax.nn.one_hot(obs.joint_to[..., :num_joints], num_shapes, dtype=jnp.float32) * is_joint
    owners = jax.nn.one_hot(obs.thruster_owner, num_shapes, dtype=jnp.float32) * obs.thruster_mask[..., None]
    parts = [obs.polygons, obs.circles, obs.joints[..., :num_joints, :], obs.thrusters, ends_from, ends_to, owners]
    return jnp.concatenate([part.reshape(*part.shape[:-2], -1) for part in parts], axis=-1)


def flat_size(capacity: Capacity) -> int:
    """Numbers in a flat observation."""
    entities = (
        capacity.polygons * num_polygon_features(capacity)
        + capacity.circles * NUM_CIRCLE_FEATURES
        + capacity.joints * NUM_JOINT_FEATURES
        + capacity.thrusters * NUM_THRUSTER_FEATURES
    )
    return entities + (2 * capacity.joints + capacity.thrusters) * capacity.shapes
