"""The policy of a teacher that builds levels: its observation of a level under construction, and its network.

A flat network over numbers for every slot, whose outputs are limited to the choices that a step allows.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array, Capacity
from kinetix_dist.env.action_spaces.masked_categorical import forbid
from kinetix_dist.level.construction import Addition, Construction, num_steps
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Role
from kinetix_dist.models.flat_mlp import FlatMlp

NUM_NOISE = 8  # random numbers of a level that its teacher sees from the start, so that it can build many kinds


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class TeacherObs:
    """Observation of a teacher before a step."""

    features: Array  # [B, features] float32
    allowed: tuple[Array, ...]  # [B, choices] bool of each head


class TeacherPolicy(nn.Module):
    """TeacherObs -> (logits of each head [B, choices] float32, value [B] float32); forbidden choices never happen."""

    hidden_size: int
    hidden_layers: int
    head_sizes: tuple[int, ...]

    @nn.compact
    def __call__(self, obs: TeacherObs) -> tuple[tuple[Array, ...], Array]:
        network = FlatMlp(
            self.hidden_size, self.hidden_size, self.hidden_layers, self.head_sizes, jnp.float32, name="network"
        )
        logits, value = network(obs.features)
        return forbid(logits, obs.allowed), value


def construction_features(building: Construction, step: Array, noise: Array, capacity: Capacity) -> Array:
    """[features] float32 of one level that is being built, before action number `step` (int32).

    noise [NUM_NOISE]: uniform numbers, the same in all steps of a level.
    """
    draft, new = building.draft, building.shape
    shapes = jax.tree.map(lambda column: column[NUM_WALLS:], draft.shapes)
    joints, thrusters = draft.joints, draft.thrusters
    half = jnp.maximum(jnp.abs(shapes.vertices).max(1), shapes.radius[:, None])
    roles = (shapes.role[:, None] == jnp.array(list(Role)[1:], jnp.int32)) * 1.0
    by_slot = [
        shapes.position / WORLD_SIZE_M,
        jnp.stack([jnp.cos(shapes.angle), jnp.sin(shapes.angle), shapes.is_fixed, shapes.num_joints / 2.0], -1),
        half,
        roles,
    ]
    slots = jnp.concatenate([part * shapes.active[:, None] for part in by_slot], axis=-1)
    new_half = jnp.maximum(jnp.abs(new.vertices).max(0), new.radius)
    parts = [
        slots.reshape(-1),
        shapes.active * 1.0,
        jnp.stack([joints.active, joints.motor_on & joints.active], -1).reshape(-1) * 1.0,
        thrusters.active * 1.0,
        (building.addition == jnp.array(list(Addition), jnp.int32)) * 1.0,
        new_half,
        jnp.stack([jnp.cos(new.angle), jnp.sin(new.angle)]),
        (step == jnp.arange(num_steps(capacity))) * 1.0,
        2.0 * noise - 1.0,
    ]
    return jnp.concatenate([part.astype(jnp.float32) for part in parts])
