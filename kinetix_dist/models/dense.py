"""Parameters of a dense layer, for what computes it otherwise than `flax.linen.Dense`."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array
from kinetix_dist.models.stored import stored_gradient


class DenseParameters(nn.Module):
    """Kernel [F, width] and bias [width], named and drawn as those of a Dense of this name."""

    width: int
    kernel_init: Callable[..., Array]

    @nn.compact
    def __call__(self, num_features: int) -> tuple[Array, Array]:
        kernel = self.param("kernel", self.kernel_init, (num_features, self.width))
        return kernel, self.param("bias", nn.initializers.zeros, (self.width,))


def add_bias(x: Array, bias: Array) -> Array:
    """x [B, C, F] + bias [F]. The gradient of the bias is summed over B first, C x F numbers side by side: a GPU sums
    rows of a few numbers slowly."""
    flat = x.reshape(x.shape[0], -1) + stored_gradient(jnp.tile(bias, x.shape[1]))
    return flat.reshape(x.shape)
