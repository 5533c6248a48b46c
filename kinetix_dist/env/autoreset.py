"""Auto-reset: a world whose episode ended goes on with a new one on the same level, in the same step.

A reset is a selection between two states, because every level's first state is prepared once. Two layouts occur:
packed engine arrays have the world axis last (`[field, W]`), all others have it first.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.level.level import select_first


def select_worlds_last(done: Array, initial: Any, current: Any) -> Any:
    """`initial` where done [W], else `current`; leaves [..., W]."""
    return jax.tree.map(lambda a, b: jnp.where(done, a, b), initial, current)


def select_worlds_first(done: Array, initial: Any, current: Any) -> Any:
    """`initial` where done [W], else `current`; leaves [W, ...]."""
    return select_first(done, initial, current)
