"""The gate (models/gate.py, whose formulas and arguments these are) by kernels for Hopper GPUs, with its gradient."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.kernels.gate_backward import gate_backward
from kinetix_dist.models.kernels.gate_forward import gate_forward
from kinetix_dist.models.kernels.gate_weights import gate_weight_gradients
from kinetix_dist.models.kernels.tiles import ROWS, WIDTH

_BIAS_ROWS = 8  # of the packed weights; the first holds the bias


@functools.partial(jax.custom_vjp, nondiff_argnums=(6,))
def gate(
    x: Array, y: Array, kernel_y: Array, kernel_x: Array, kernel_h: Array, bias: Array, interpret: bool = False
) -> Array:
    """`y` let into the stream `x`, both [..., 128] bfloat16. interpret: on a CPU, for tests."""
    weights = pack(kernel_y, kernel_x, kernel_h, bias)
    (out,) = gate_forward(_rows(x), _rows(y), weights, keep=False, interpret=interpret)
    return _like(out, x)


def pack(kernel_y: Array, kernel_x: Array, kernel_h: Array, bias: Array) -> Array:
    """[136, 768] bfloat16: the kernels side by side, and below them the bias in a row of its own.

    An array of its own: the copy engine wants addresses that are multiples of 256, and parameters are slices of one
    flat array.
    """
    kernels = jnp.concatenate([kernel_y, kernel_x, kernel_h], axis=1)
    below = jnp.zeros((_BIAS_ROWS, kernels.shape[1]), jnp.float32).at[0, :WIDTH].set(bias)
    return jnp.concatenate([kernels, below]).astype(jnp.bfloat16)


def _forward(
    x: Array, y: Array, kernel_y: Array, kernel_x: Array, kernel_h: Array, bias: Array, interpret: bool
) -> tuple[Array, tuple[Array, ...]]:
    weights = pack(kernel_y, kernel_x, kernel_h, bias)
    rows_x, rows_y = _rows(x), _rows(y)
    out, r, z, h = gate_forward(rows_x, rows_y, weights, keep=True, interpret=interpret)
    return _like(out, x), (x, y, r, z, h, weights)


def _backward(interpret: bool, residuals: tuple[Array, ...], grad: Array) -> tuple[Array, ...]:
    x, y, r, z, h, weights = residuals
    rows_x, rows_y = _rows(x), _rows(y)
    grad_x, grad_y, grad_rz, grad_h, rx = gate_backward(_rows(grad), rows_x, r, z, h, weights, interpret=interpret)
    of_kernels = gate_weight_gradients(rows_x, rows_y, rx, grad_rz, grad_h, interpret=interpret)
    grad_bias = -jnp.sum(grad_rz[:, WIDTH:].astype(jnp.float32), axis=0)
    return (_like(grad_x, x), _like(grad_y, y), *of_kernels, grad_bias)


gate.defvjp(_forward, _backward)


def _rows(x: Array) -> Array:
    """[rows, 128], filled up with zeros to whole tiles; these give zeros to every gradient."""
    rows = x.reshape(-1, WIDTH)
    missing = -rows.shape[0] % ROWS
    return jnp.pad(rows, ((0, missing), (0, 0))) if missing else rows


def _like(rows: Array, x: Array) -> Array:
    return rows[: x.size // WIDTH].reshape(x.shape)
