"""The flat policy: every feature of the observation in one vector, one wide layer, then actor and critic.

Smaller and faster than the transformer and tied to one size of level: slots have meaning, entities do not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.models.towers import TANH_GAIN, Towers

if TYPE_CHECKING:
    from kinetix_dist.env.observations.entities import EntityObs


class FlatMlp(nn.Module):
    """EntityObs of a batch of worlds -> (logits of each head [B, choices] float32, value [B] float32)."""

    flat_size: int
    hidden_size: int
    hidden_layers: int
    head_sizes: tuple[int, ...]
    dtype: Any

    @nn.compact
    def __call__(self, obs: EntityObs) -> tuple[tuple[Array, ...], Array]:
        dense = nn.Dense(self.flat_size, kernel_init=nn.initializers.orthogonal(TANH_GAIN), name="encoder")
        embedding = jnp.tanh(dense(flatten(obs))).astype(self.dtype)
        return Towers(self.hidden_size, self.hidden_layers, self.head_sizes, name="towers")(embedding)


def flatten(obs: EntityObs) -> Array:
    """Features of all entities, who is joined to whom (one-hot) and which slots are in use: [B, features] float32."""
    num_shapes = obs.shape_mask.shape[-1]
    links = [jax.nn.one_hot(index, num_shapes) for index in (obs.joint_from, obs.joint_to, obs.thruster_owner)]
    masks = [obs.joint_mask, obs.joint_mask, obs.thruster_mask]
    links = [link * mask[..., None] for link, mask in zip(links, masks)]
    parts = [obs.polygons, obs.circles, obs.joints, obs.thrusters, *links, obs.shape_mask]
    return jnp.concatenate([part.reshape(part.shape[0], -1).astype(jnp.float32) for part in parts], axis=-1)
