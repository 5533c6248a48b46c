"""Branches that worlds stepped together take together, so that what none of them needs is not computed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp


def choose(condition: jax.Array, this: Any, other: Any) -> Any:
    """Selects `this` where the condition holds, else `other`: two trees of one structure. The condition broadcasts
    against every leaf."""
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), this, other)


@jax.custom_batching.custom_vmap
def in_any_world(condition: jax.Array) -> jax.Array:
    """Returns True if the condition [] holds in any of the worlds that are mapped over: one value for all of them."""
    return condition


@in_any_world.def_vmap
def _in_any_world(axis_size: int, in_batched: list[bool], condition: jax.Array) -> tuple[jax.Array, bool]:
    return in_any_world(jnp.any(condition) if in_batched[0] else condition), False
