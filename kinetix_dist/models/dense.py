"""Parameters of a dense layer, for what computes it otherwise than `flax.linen.Dense`."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array


class DenseParameters(nn.Module):
    """Kernel [F, width] and bias [width], named and drawn as those of a Dense of this name."""

    width: int
    kernel_init: Callable[..., Array]

    @nn.compact
    def __call__(self, num_features: int) -> tuple[Array, Array]:
        kernel = self.param("kernel", self.kernel_init, (num_features, self.width), jnp.float32)
        return kernel, self.param("bias", nn.initializers.zeros, (self.width,), jnp.float32)
