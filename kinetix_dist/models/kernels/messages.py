"""Messages along joints and from thrusters by kernels (cuda/messages.cu), with their gradient."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.kernels import cuda_kernel
from kinetix_dist.models.kernels.cuda_kernel import CudaKernel
from kinetix_dist.models.kernels.support import WIDTH, worlds_a_message_tile

_BLOCKS = 2  # of a multiprocessor; two have a half of the columns each


def pack_ends(first: Array, second: Array | None, mask: Array) -> Array:
    """[B, K] uint32 of the tokens at the ends of K joints or thrusters that exist, with a bit that says so; else 0."""
    words = first.astype(jnp.uint32) | jnp.uint32(1 << 16)
    if second is not None:
        words |= second.astype(jnp.uint32) << 8
    return jnp.where(mask, words, jnp.uint32(0))


@jax.custom_vjp
def add_messages(
    x: Array,
    joints: Array,
    thrusters: Array,
    joint_terms: Array,
    thruster_terms: Array,
    joint_kernel: Array,
    thruster_kernel: Array,
) -> Array:
    """`x` [B, n, 128] bfloat16 and what joints [B, J] and thrusters [B, T] tell it, see `pack_ends`.

    joint_terms: [B, J, 128], thruster_terms: [B, T, 128] bfloat16, the share of joint or thruster itself; joint_kernel:
    [256, 128] of the tokens at both ends, thruster_kernel: [128, 128], float32.
    """
    return _forward(x, joints, thrusters, joint_terms, thruster_terms, joint_kernel, thruster_kernel)[0]


def _forward(
    x: Array,
    joints: Array,
    thrusters: Array,
    joint_terms: Array,
    thruster_terms: Array,
    joint_kernel: Array,
    thruster_kernel: Array,
) -> tuple[Array, tuple[Array, ...]]:
    weights = jnp.concatenate([joint_kernel, thruster_kernel]).astype(jnp.bfloat16)
    kernel, blocks = _kernel("messages", x, joints, thrusters)
    operands = (jnp.int32([x.shape[0]]), x, joints, thrusters, joint_terms, thruster_terms, weights)
    (out,) = cuda_kernel.call(kernel, [_like(x)], blocks, *operands)
    return out, (x, joints, thrusters, weights)


def _backward(residuals: tuple[Array, ...], grad: Array) -> tuple[Array | None, ...]:
    x, joints, thrusters, weights = residuals
    count, ends = jnp.int32([x.shape[0]]), (joints, thrusters)
    kernel, blocks = _kernel("messages_gradient", x, *ends)
    of_terms = [jax.ShapeDtypeStruct((*each.shape, WIDTH), x.dtype) for each in ends]
    grad_x, *grad_terms = cuda_kernel.call(kernel, [_like(x), *of_terms], blocks, count, grad, *ends, weights)
    kernel, blocks = _kernel("messages_weight_gradient", x, *ends)
    of_pairs = jax.ShapeDtypeStruct((blocks // 2, *weights.shape), jnp.float32)
    (grad_weights,) = cuda_kernel.call(kernel, [of_pairs], blocks, count, x, grad, *ends)
    of_joints, of_thrusters = jnp.split(jnp.sum(grad_weights, axis=0), [2 * WIDTH])
    return grad_x, None, None, *grad_terms, of_joints, of_thrusters


add_messages.defvjp(_forward, _backward)


def _kernel(name: str, x: Array, joints: Array, thrusters: Array) -> tuple[CudaKernel, int]:
    """And how many of its blocks run."""
    counts = {"TOKENS": x.shape[1], "JOINTS": joints.shape[1], "THRUSTERS": thrusters.shape[1]}
    worlds = worlds_a_message_tile(*counts.values())
    kernel = CudaKernel("messages.cu", name, (*counts.items(), ("WORLDS_A_TILE", worlds)))
    return kernel, cuda_kernel.num_blocks(kernel, 2 * -(-x.shape[0] // worlds), _BLOCKS)


def _like(x: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)
