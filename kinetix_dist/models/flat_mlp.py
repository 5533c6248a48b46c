"""The flat policy: an observation that is one vector, one wide layer, then actor and critic.

Smaller and faster than the transformer and tied to one size of level: slots have meaning, entities do not.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.models.gru import apply_towers
from kinetix_dist.models.hidden_units import note_units
from kinetix_dist.models.towers import TANH_GAIN, Towers


class FlatMlp(nn.Module):
    """A vector a world, [B, features] float32 -> (logits of each head [B, choices] float32, value [B] float32)."""

    flat_size: int
    hidden_size: int
    hidden_layers: int
    head_sizes: tuple[int, ...]
    dtype: Any
    memory_size: int = 0  # see gru.py; 0: none

    @nn.compact
    def __call__(self, obs: Array, memory: Array | None = None, *, is_first: Array | None = None) -> Any:
        dense = nn.Dense(self.flat_size, kernel_init=nn.initializers.orthogonal(TANH_GAIN), name="encoder")
        embedding = jnp.tanh(dense(obs)).astype(self.dtype)
        note_units(self, "encoder", embedding)
        towers = Towers(self.hidden_size, self.hidden_layers, self.head_sizes, name="towers")
        return apply_towers(towers, embedding, memory, is_first, self.memory_size)
