"""The attention part of a layer by kernels (cuda/attention.cu), with its gradient."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.kernels import cuda_kernel
from kinetix_dist.models.kernels.cuda_kernel import ROWS, CudaKernel

_COLUMNS = 64  # of queries, keys and values, filled up with zeros
_FORWARD_BLOCKS, _BACKWARD_BLOCKS = 3, 2  # of a multiprocessor


@jax.custom_vjp
def attention_branch(
    x: Array, mask_words: Array, kernel: Array, bias: Array, out_kernel: Array, out_bias: Array
) -> tuple[Array, Array]:
    """`x`, and relu(attention(normalise(x)) @ out_kernel + out_bias), for the stream and its branch: one kernel
    adds up the gradients of both.

    x: [B, n, 128] bfloat16; mask_words: [4, B, n] uint32, see models/attention.py; kernel: [128, 48] of queries, keys
    and values of eight heads of two numbers each, bias: [48]; out_kernel: [16, 128], out_bias: [128]; float32.
    """
    return _forward(x, mask_words, kernel, bias, out_kernel, out_bias)[0]


def _forward(
    x: Array, mask_words: Array, kernel: Array, bias: Array, out_kernel: Array, out_bias: Array
) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
    missing = _COLUMNS - kernel.shape[1]
    weights = jnp.pad(kernel, ((0, 0), (0, missing))).astype(jnp.bfloat16)
    parameters = (weights, jnp.pad(bias, (0, missing)), out_kernel.astype(jnp.bfloat16), out_bias)
    like = jax.ShapeDtypeStruct(x.shape, x.dtype)
    kernel_of, blocks = _kernel("attention", x, _FORWARD_BLOCKS)
    (y,) = cuda_kernel.call(kernel_of, [like], blocks, jnp.int32([x.shape[0]]), x, mask_words, *parameters)
    return (x, y), (x, mask_words, *parameters)


def _backward(residuals: tuple[Array, ...], grads: tuple[Array, Array]) -> tuple[Array | None, ...]:
    x, mask_words, *parameters = residuals
    kernel_of, blocks = _kernel("attention_gradient", x, _BACKWARD_BLOCKS)
    out = [jax.ShapeDtypeStruct(x.shape, x.dtype)]
    out += [jax.ShapeDtypeStruct((blocks, *a.shape), jnp.float32) for a in parameters]
    grad_x, *of_blocks = cuda_kernel.call(
        kernel_of, out, blocks, jnp.int32([x.shape[0]]), x, *grads, mask_words, *parameters
    )
    of_kernel, of_bias, of_out_kernel, of_out_bias = (jnp.sum(each, axis=0) for each in of_blocks)
    columns = 3 * parameters[2].shape[0]
    return grad_x, None, of_kernel[:, :columns], of_bias[:columns], of_out_kernel, of_out_bias


attention_branch.defvjp(_forward, _backward)


def _kernel(name: str, x: Array, at_most: int) -> tuple[CudaKernel, int]:
    """And how many of its blocks run."""
    kernel, worlds_a_tile = CudaKernel("attention.cu", name, (("TOKENS", x.shape[1]),)), ROWS // x.shape[1]
    return kernel, cuda_kernel.num_blocks(kernel, -(-x.shape[0] // worlds_a_tile), at_most)
