"""The gate of gate.py as one GPU kernel forward and one backward (Pallas, Triton), for rows in blocks.

Written out in XLA a gate reads and writes its intermediate values some twenty times; a block of rows fits in the
registers of a few warps, so that the forward kernel reads x and y and writes the result. The backward kernel computes
r, z and h again and writes, besides the gradients of x and y, what the gradients of the kernels are products of:
those sum over all rows and stay with XLA.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton

from jax2d.scene import Array
from kinetix_dist.models.gate import gate, outer

BLOCK_ROWS = 128  # fewer rows a block would read the kernels from the L2 cache more often
FORWARD_WARPS = 8
BACKWARD_WARPS = 8


def fused_gate(x: Array, y: Array, kernel_y: Array, kernel_x: Array, kernel_h: Array, bias: Array) -> Array:
    """`gate` of the same arguments; in one kernel on CUDA if rows come in whole blocks and F is a power of two."""
    num_rows, width = x.size // x.shape[-1], x.shape[-1]
    if num_rows % BLOCK_ROWS or width < 16 or width & (width - 1):
        return gate(x, y, kernel_y, kernel_x, kernel_h, bias)
    return jax.lax.platform_dependent(
        x, y, kernel_y, kernel_x, kernel_h, bias, cuda=functools.partial(_on_rows, False), default=gate
    )


def interpreted_gate(x: Array, y: Array, kernel_y: Array, kernel_x: Array, kernel_h: Array, bias: Array) -> Array:
    """The kernels, run by the Pallas interpreter on any device: how tests reach them without a GPU."""
    return _on_rows(True, x, y, kernel_y, kernel_x, kernel_h, bias)


def _on_rows(interpret: bool, x: Array, y: Array, *parameters: Array) -> Array:
    rows = _gate_rows(interpret, x.reshape(-1, x.shape[-1]), y.reshape(-1, x.shape[-1]), *parameters)
    return rows.reshape(x.shape)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _gate_rows(interpret: bool, x: Array, y: Array, kernel_y: Array, kernel_x: Array, kernel_h: Array, bias: Array):
    return _forward(interpret, x, y, kernel_y, kernel_x, kernel_h, bias)[0]


def _forward(interpret: bool, x: Array, y: Array, *parameters: Array) -> tuple[Array, tuple[Array, ...]]:
    kernel_y, kernel_x, kernel_h = (kernel.astype(x.dtype) for kernel in parameters[:3])
    call = _call(_forward_kernel, x, [x.shape[1]], FORWARD_WARPS, interpret, num_blocked=2)
    (out,) = call(x, y, kernel_y, kernel_x, kernel_h, parameters[3].reshape(1, -1))
    return out, (x, y, *parameters)


def _backward(interpret: bool, residuals: tuple[Array, ...], grad: Array) -> tuple[Array, ...]:
    x, y, *parameters = residuals
    width = x.shape[1]
    kernel_y, kernel_x, kernel_h = (kernel.astype(x.dtype) for kernel in parameters[:3])
    widths = [width, width, 3 * width, width]
    call = _call(_backward_kernel, x, widths, BACKWARD_WARPS, interpret, num_blocked=3)
    grad_x, grad_y, grad_all, rx = call(
        x, y, grad, kernel_y, kernel_x, kernel_h, kernel_y.T, kernel_x.T, kernel_h.T, parameters[3].reshape(1, -1)
    )
    grad_bias = -jnp.sum(grad_all[:, width : 2 * width].astype(jnp.float32), axis=0)
    return (
        grad_x,
        grad_y,
        outer(y, grad_all),
        outer(x, grad_all[:, : 2 * width]),
        outer(rx, grad_all[:, 2 * width :]),
        grad_bias.astype(parameters[3].dtype),
    )


_gate_rows.defvjp(_forward, _backward)


def _call(kernel: Any, like: Array, widths: list[int], num_warps: int, interpret: bool, *, num_blocked: int) -> Any:
    """A pallas_call over blocks of rows: the first `num_blocked` operands and all results by rows, the others whole."""
    num_rows = like.shape[0]

    def blocked(width: int) -> pl.BlockSpec:
        return pl.BlockSpec((BLOCK_ROWS, width), lambda block: (block, 0))

    def call(*operands: Array) -> Any:
        whole = [pl.BlockSpec(x.shape, lambda block: (0, 0)) for x in operands[num_blocked:]]
        return pl.pallas_call(
            kernel,
            grid=(num_rows // BLOCK_ROWS,),
            in_specs=[blocked(x.shape[1]) for x in operands[:num_blocked]] + whole,
            out_specs=[blocked(width) for width in widths],
            out_shape=[jax.ShapeDtypeStruct((num_rows, width), like.dtype) for width in widths],
            compiler_params=None if interpret else triton.CompilerParams(num_warps=num_warps, num_stages=2),
            interpret=interpret,
        )(*operands)

    return call


def _gates(x: Array, y: Array, kernel_y: Any, kernel_x: Any, kernel_h: Any, bias: Any) -> tuple[Array, ...]:
    """r, z, h in float32 and r x in the type of x, of one block."""
    width = x.shape[1]
    r = jax.nn.sigmoid(_dot(y, kernel_y[:, :width]) + _dot(x, kernel_x[:, :width]))
    rx = (r * x.astype(jnp.float32)).astype(x.dtype)
    middle = slice(width, 2 * width)
    z = jax.nn.sigmoid(_dot(y, kernel_y[:, middle]) + _dot(x, kernel_x[:, middle]) - bias[...])
    h = jnp.tanh(_dot(y, kernel_y[:, 2 * width : 3 * width]) + _dot(rx, kernel_h[...]))
    return r, z, h, rx


def _forward_kernel(x_ref: Any, y_ref: Any, kernel_y: Any, kernel_x: Any, kernel_h: Any, bias: Any, out_ref: Any):
    x = x_ref[...]
    _, z, h, _ = _gates(x, y_ref[...], kernel_y, kernel_x, kernel_h, bias)
    wide = x.astype(jnp.float32)
    out_ref[...] = (wide + z * (h - wide)).astype(out_ref.dtype)


def _backward_kernel(
    # Blocks of rows in:
    x_ref: Any,
    y_ref: Any,
    grad_ref: Any,
    # Parameters:
    kernel_y: Any,
    kernel_x: Any,
    kernel_h: Any,
    kernel_y_t: Any,
    kernel_x_t: Any,
    kernel_h_t: Any,
    bias: Any,
    # Blocks of rows out:
    grad_x_ref: Any,
    grad_y_ref: Any,
    grad_all_ref: Any,
    rx_ref: Any,
):
    x = x_ref[...]
    width = x.shape[1]
    r, z, h, rx = _gates(x, y_ref[...], kernel_y, kernel_x, kernel_h, bias)
    rx_ref[...] = rx
    wide, grad = x.astype(jnp.float32), grad_ref[...].astype(jnp.float32)
    # Of the arguments of the three nonlinearities.
    grad_h = (grad * z * (1 - h * h)).astype(x.dtype)
    grad_z = (grad * (h - wide) * z * (1 - z)).astype(x.dtype)
    grad_rx = _dot(grad_h, kernel_h_t[...])
    grad_r = (grad_rx * wide * r * (1 - r)).astype(x.dtype)
    grad_all_ref[:, :width] = grad_r
    grad_all_ref[:, width : 2 * width] = grad_z
    grad_all_ref[:, 2 * width : 3 * width] = grad_h
    # Of the inputs.
    first, middle, last = slice(0, width), slice(width, 2 * width), slice(2 * width, 3 * width)
    grad_y = _dot(grad_r, kernel_y_t[first]) + _dot(grad_z, kernel_y_t[middle]) + _dot(grad_h, kernel_y_t[last])
    grad_y_ref[...] = grad_y.astype(x.dtype)
    grad_x = grad * (1 - z) + grad_rx * r + _dot(grad_r, kernel_x_t[first]) + _dot(grad_z, kernel_x_t[middle])
    grad_x_ref[...] = grad_x.astype(x.dtype)


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, preferred_element_type=jnp.float32)
