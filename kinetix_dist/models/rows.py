"""Reading and adding rows of a few tokens by index: the two halves of message passing.

`take_rows` and `add_rows` are each other's gradient. A scatter-add would use atomics (slow in bfloat16, and not
reproducible on a GPU); with a handful of messages a world, a sum over messages of "mine or zero" fuses with its
neighbours and gives the same bits every time.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array


@jax.custom_vjp
def take_rows(x: Array, index: Array) -> Array:
    """x [B, n, F], index [B, K] int32 in 0..n-1 -> [B, K, F]."""
    return jax.vmap(lambda rows, i: rows.at[i].get(mode="promise_in_bounds"))(x, index)


def _take_forward(x: Array, index: Array) -> tuple[Array, tuple[Array, Array]]:
    return take_rows(x, index), (jnp.zeros((x.shape[1], 0), x.dtype), index)


def _take_backward(residuals: tuple[Array, Array], grad: Array) -> tuple[Array, None]:
    like, index = residuals
    return _sum_rows(grad, index, like.shape[0]), None


take_rows.defvjp(_take_forward, _take_backward)


@jax.custom_vjp
def add_rows(x: Array, index: Array, messages: Array) -> Array:
    """x [B, n, F] with messages [B, K, F] added to the rows index [B, K]."""
    return x + _sum_rows(messages, index, x.shape[1])


def _add_forward(x: Array, index: Array, messages: Array) -> tuple[Array, Array]:
    return add_rows(x, index, messages), index


def _add_backward(index: Array, grad: Array) -> tuple[Array, None, Array]:
    return grad, None, take_rows(grad, index)


add_rows.defvjp(_add_forward, _add_backward)


def _sum_rows(messages: Array, index: Array, num_rows: int) -> Array:
    """[B, num_rows, F]: the sum, in float32, of the messages whose index is that row."""
    rows = np.arange(num_rows, dtype=np.int32)[:, None]
    total = jnp.zeros((messages.shape[0], num_rows, messages.shape[2]), jnp.float32)
    for k in range(messages.shape[1]):
        is_mine = index[:, k, None, None] == rows
        total = total + jnp.where(is_mine, messages[:, k : k + 1].astype(jnp.float32), 0.0)
    return total.astype(messages.dtype)
