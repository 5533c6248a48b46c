"""The feed-forward part of a layer by kernels (cuda/feed_forward.cu), with its gradient."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.kernels import cuda_kernel
from kinetix_dist.models.kernels.cuda_kernel import ROWS, CudaKernel
from kinetix_dist.models.kernels.support import WIDTH

_FORWARD = CudaKernel("feed_forward.cu", "feed_forward")
_BACKWARD = CudaKernel("feed_forward.cu", "feed_forward_gradient")
_FORWARD_BLOCKS, _BACKWARD_BLOCKS = 3, 2  # of a multiprocessor


@jax.custom_vjp
def feed_forward_branch(x: Array, kernel: Array, bias: Array) -> tuple[Array, Array]:
    """`x`, and relu(normalise(x) @ kernel + bias), for the stream and its branch: one kernel adds up the
    gradients of both. x: [..., 128] bfloat16; kernel: [128, 128], bias: [128] float32."""
    return _forward(x, kernel, bias)[0]


def _forward(x: Array, kernel: Array, bias: Array) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
    num_rows, weights = _num_rows(x), kernel.astype(jnp.bfloat16)
    blocks = cuda_kernel.num_blocks(_FORWARD, -(-num_rows // ROWS), _FORWARD_BLOCKS)
    (y,) = cuda_kernel.call(_FORWARD, [_like(x)], blocks, jnp.int32([num_rows]), x, weights, bias)
    return (x, y), (x, weights, bias)


def _backward(residuals: tuple[Array, ...], grads: tuple[Array, Array]) -> tuple[Array, ...]:
    x, weights, bias = residuals
    num_rows = _num_rows(x)
    blocks = cuda_kernel.num_blocks(_BACKWARD, -(-num_rows // ROWS), _BACKWARD_BLOCKS)
    out = [_like(x), *(jax.ShapeDtypeStruct((blocks, *a.shape), jnp.float32) for a in (weights, bias))]
    grad_x, *of_blocks = cuda_kernel.call(_BACKWARD, out, blocks, jnp.int32([num_rows]), x, *grads, weights, bias)
    return grad_x, *(jnp.sum(each, axis=0) for each in of_blocks)


feed_forward_branch.defvjp(_forward, _backward)


def _num_rows(x: Array) -> int:
    return x.size // WIDTH


def _like(x: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)
