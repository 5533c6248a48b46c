"""Dense layers: products of activations (bfloat16 or float32) with float32 parameters, and results stored by a GPU.

A parameter is cast to the type of the activations for the product, and its gradient leaves the product in float32: with
plain autodiff the gradient of a cast parameter would be rounded to bfloat16 before it is averaged over devices.

XLA fuses what it can, also where a loop then computes the same number many times over or cuts an array across its rows:
kernels of norms, sums over a batch and means took up to ten times as long as their traffic (bench/step_profile.py).
`stored` separates the operations before it from those after it. CPUs fuse by other rules and gain nothing by it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import linen as nn

from jax2d.scene import Array


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def contract(spec: str, x: Array, kernel: Array) -> Array:
    """`jnp.einsum(spec, x, kernel)` in the type of `x`; an index of an operand is in the other one or in the result."""
    return jnp.einsum(spec, x, kernel.astype(x.dtype))


def _contract_forward(spec: str, x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return contract(spec, x, kernel), (x, kernel)


def _contract_backward(spec: str, residuals: tuple[Array, Array], grad: Array) -> tuple[Array, Array]:
    x, kernel = residuals
    operands, result = spec.split("->")
    of_x, of_kernel = operands.split(",")
    grad_x = jnp.einsum(f"{result},{of_kernel}->{of_x}", grad, kernel.astype(x.dtype))
    grad_kernel = jnp.einsum(f"{of_x},{result}->{of_kernel}", x, grad, preferred_element_type=jnp.float32)
    return grad_x, grad_kernel.astype(kernel.dtype)


contract.defvjp(_contract_forward, _contract_backward)


def linear(x: Array, kernel: Array) -> Array:
    """x [B, n, i] or [B, i] times kernel [i, o] (no bias)."""
    return contract("bni,io->bno" if x.ndim == 3 else "bi,io->bo", x, kernel)


Arrays = TypeVar("Arrays")  # an array, or a tree of them


def stored(x: Arrays) -> Arrays:
    """`x`; on a GPU, whatever uses it reads it from memory."""
    return jax.lax.platform_dependent(x, cpu=lambda x: x, default=jax.lax.optimization_barrier)


@jax.custom_vjp
def stored_gradient(x: Array) -> Array:
    """`x`, whose gradient is `stored`."""
    return x


stored_gradient.defvjp(lambda x: (x, None), lambda _, grad: (stored(grad),))


class DenseParameters(nn.Module):
    """Kernel [F, width] and bias [width], named and drawn as those of a Dense of this name."""

    width: int
    kernel_init: Callable[..., Array]

    @nn.compact
    def __call__(self, num_features: int) -> tuple[Array, Array]:
        kernel = self.param("kernel", self.kernel_init, (num_features, self.width), jnp.float32)
        return kernel, self.param("bias", nn.initializers.zeros, (self.width,), jnp.float32)
