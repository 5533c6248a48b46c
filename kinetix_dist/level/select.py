"""Choosing between two trees of arrays, element by element of their first axis."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array


def select_first(mask: Array, new: Any, old: Any) -> Any:
    """`new` where mask [N], else `old`; leaves [N, ...]."""

    def select(a: Array, b: Array) -> Array:
        return jnp.where(jnp.reshape(mask, (-1, *[1] * (jnp.ndim(b) - 1))), a, b)

    return jax.tree.map(select, new, old)
