"""Which shapes are one body: held together by one joint, or by a chain of joints. Pure and traceable."""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array


def connections(end_a: Array, end_b: Array, joint_active: Array, num_shapes: int) -> tuple[Array, Array]:
    """By one joint, and by any number of them: two [..., n, n] bool, symmetric and True on the diagonal.

    end_a, end_b [..., J] int32: the shapes a joint holds; joint_active [..., J] bool.
    """
    index = jnp.arange(num_shapes)
    ends_a = (end_a[..., None] == index) & joint_active[..., None]
    ends_b = (end_b[..., None] == index) & joint_active[..., None]
    joined = (ends_a[..., :, None] & ends_b[..., None, :]).any(axis=-3)
    one = joined | jnp.swapaxes(joined, -1, -2) | jnp.eye(num_shapes, dtype=bool)
    any_number = one
    # Each squaring doubles the length of the chains followed; the longest has a joint between any two shapes.
    longest = min(joint_active.shape[-1], num_shapes - 1)
    for _ in range(max(longest - 1, 0).bit_length()):
        any_number = (any_number[..., :, :, None] & any_number[..., None, :, :]).any(axis=-2)
    return one, any_number
