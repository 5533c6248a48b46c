"""Actor and critic: two towers of tanh layers over one embedding, computed side by side as batched products."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.models.colour_readout import ColourReadOut
from kinetix_dist.models.hidden_units import UNITS, note_features, note_units
from kinetix_dist.models.linear import linear, stored_gradient

orthogonal = nn.initializers.orthogonal
TANH_GAIN = math.sqrt(2.0)
ACTOR_OUTPUT_GAIN = 0.01  # starts near the uniform policy


def stacked(initializer: Callable[..., Any]) -> Callable[..., Any]:
    """An initializer of `[k, ...]` that draws each of the k parts on its own."""

    def init(key: Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> Array:
        return jnp.stack([initializer(part, shape[1:], dtype) for part in prng.split(key, shape[0])])

    return init


class Towers(nn.Module):
    """Embedding [B, E] -> (logits of each head [B, choices] float32, value [B] float32)."""

    hidden_size: int
    hidden_layers: int
    head_sizes: tuple[int, ...]

    @nn.compact
    def __call__(
        self, embedding: Array, by_colour: tuple[Array, Array] | None = None
    ) -> tuple[tuple[Array, ...], Array]:
        """by_colour: read-outs of motor colours and of thruster colours, where heads read these (colour_readout.py)."""
        both = jnp.broadcast_to(embedding, (2, *embedding.shape))  # actor, critic
        for layer in range(self.hidden_layers):
            shape = (2, both.shape[-1], self.hidden_size)
            kernel = self.param(f"kernel_{layer}", stacked(orthogonal(TANH_GAIN)), shape, jnp.float32)
            bias = self.param(f"bias_{layer}", nn.initializers.zeros, (2, self.hidden_size), jnp.float32)
            both = jnp.tanh(jax.vmap(linear)(both, kernel) + bias[:, None].astype(both.dtype))
            self._note_layer(layer, both)
        actor, critic = both.astype(jnp.float32)  # the last layer is small: float32 keeps log-probabilities exact
        note_features(self, actor, critic)
        value = nn.Dense(1, kernel_init=orthogonal(1.0), name="critic_output")(critic)
        if by_colour is not None:
            read_out = ColourReadOut(self.hidden_size, self.head_sizes, ACTOR_OUTPUT_GAIN, name="read_out")
            return read_out(*by_colour, both[0]), value[..., 0]
        logits = nn.Dense(sum(self.head_sizes), kernel_init=orthogonal(ACTOR_OUTPUT_GAIN), name="actor_output")(actor)
        logits = stored_gradient(logits)  # else the sum over the batch computes the loss's for each of its columns
        ends = [sum(self.head_sizes[:i]) for i in range(1, len(self.head_sizes))]
        return tuple(jnp.split(logits, ends, axis=-1)), value[..., 0]

    def _note_layer(self, layer: int, both: Array) -> None:
        if self.is_mutable_collection(UNITS):
            note_units(self, f"actor_{layer}", both[0])
            note_units(self, f"critic_{layer}", both[1])
