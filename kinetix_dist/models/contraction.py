"""Matrix products of activations (bfloat16 or float32) with float32 parameters.

The parameter is cast to the type of the activations for the product, and its gradient leaves the product in float32:
with plain autodiff the gradient of a cast parameter would be rounded to bfloat16 before it is averaged over devices.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

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
