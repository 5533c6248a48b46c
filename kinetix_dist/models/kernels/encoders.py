"""Encoders of what exists in a world by kernels (cuda/encoders.cu), with the gradient of their parameters."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.kernels import cuda_kernel
from kinetix_dist.models.kernels.cuda_kernel import CudaKernel
from kinetix_dist.models.kernels.support import WIDTH

_BLOCKS = {"encode": 3, "encode_and_keep": 2, "encode_gradient": 3}  # of a multiprocessor
_GROUPS = 2  # that a kernel has room for
_DEPTH_OF = 32  # rows of the gradient of a group are a multiple of


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def encode(features: Sequence[Array], kernels: Sequence[Array], biases: Sequence[Array], num_others: int) -> Array:
    """tanh(features @ kernel + bias) of one or two groups, then `num_others` tokens of ones: [B, tokens, 128] bfloat16.

    features: [B, rows, F] of each group, which has no gradient; kernels: [F, 128], biases: [128]; float32.
    """
    kernel, like, blocks = _call("encode", features, num_others)
    (tokens,) = cuda_kernel.call(kernel, [like], blocks, *_operands(features, kernels, biases))
    return tokens


def _forward(
    features: Sequence[Array], kernels: Sequence[Array], biases: Sequence[Array], num_others: int
) -> tuple[Array, tuple[Sequence[Array], Array]]:
    kernel, like, blocks = _call("encode_and_keep", features, num_others)
    tokens, slopes = cuda_kernel.call(kernel, [like, like], blocks, *_operands(features, kernels, biases))
    return tokens, (features, slopes)


def _backward(
    num_others: int, residuals: tuple[Sequence[Array], Array], grad: Array
) -> tuple[list[None], list[Array], list[Array]]:
    features, slopes = residuals
    kernel, _, blocks = _call("encode_gradient", features, num_others)
    shapes = [(blocks, _depth(each.shape[-1]), WIDTH) for each in features]
    shapes += [(1,)] * (_GROUPS - len(features))
    out = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in shapes]
    count = jnp.int32([grad.shape[0]])
    of_blocks = cuda_kernel.call(kernel, out, blocks, count, *_of_groups(features), grad, slopes)
    sums = [jnp.sum(each, axis=0) for each in of_blocks[: len(features)]]
    widths = [each.shape[-1] for each in features]
    of_kernels = [each[:width] for each, width in zip(sums, widths, strict=True)]
    of_biases = [each[width] for each, width in zip(sums, widths, strict=True)]
    return [None] * len(features), of_kernels, of_biases


encode.defvjp(_forward, _backward)


def _call(name: str, features: Sequence[Array], num_others: int) -> tuple[CudaKernel, jax.ShapeDtypeStruct, int]:
    """The kernel, what its tokens are, and how many of its blocks run."""
    num_worlds, num_tokens = features[0].shape[0], sum(each.shape[1] for each in features) + num_others
    macros = {"TOKENS": num_tokens}
    for group in range(_GROUPS):
        rows, width = features[group].shape[1:] if group < len(features) else (0, 0)
        macros |= {f"ROWS_{group}": rows, f"FEATURES_{group}": width}
    like = jax.ShapeDtypeStruct((num_worlds, num_tokens, WIDTH), jnp.bfloat16)
    kernel = CudaKernel("encoders.cu", name, tuple(macros.items()))
    tiles = sum(-(-num_worlds * each.shape[1] // cuda_kernel.ROWS) for each in features)
    return kernel, like, cuda_kernel.num_blocks(kernel, tiles, _BLOCKS[name])


def _operands(features: Sequence[Array], kernels: Sequence[Array], biases: Sequence[Array]) -> list[Array]:
    return [jnp.int32([features[0].shape[0]]), *_of_groups(features), *_of_groups(kernels), *_of_groups(biases)]


def _of_groups(arrays: Sequence[Array]) -> list[Array]:
    """One of each group; that of a group without rows is not read."""
    arrays = [array.astype(jnp.float32) for array in arrays]
    return [*arrays, *[arrays[0]] * (_GROUPS - len(arrays))]


def _depth(num_features: int) -> int:
    """Rows of the gradient of a group: of its kernel, of its bias, and zeros."""
    return num_features // _DEPTH_OF * _DEPTH_OF + _DEPTH_OF
