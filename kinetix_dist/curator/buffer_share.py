"""Worlds of groups: which they are, how many of them play levels of a buffer, and in which order."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.curator.config import CurriculumConfig


def num_from_buffer(config: CurriculumConfig, worlds_per_group: int) -> int:
    """Worlds of a group that play levels of the buffer; raises where the share is not a whole number of worlds."""
    exact = config.buffer_share * worlds_per_group
    if abs(exact - round(exact)) > 1e-6:
        raise ValueError(
            f"buffer_share {config.buffer_share} of {worlds_per_group} worlds a group is {exact:g}, no whole number; "
            "change buffer_share or the number of environments"
        )
    return round(exact)


def members(groups: Array, size: int, first: int | None = None) -> Array:
    """Numbers of what groups of `size` consist of, or the `first` of each, in order: [len(groups) * first]."""
    return (groups[:, None] * size + jnp.arange(size if first is None else first)).reshape(-1)


def by_group(tree: Any, num_groups: int) -> Any:
    """[groups * n, ...] -> [groups, n, ...]"""
    return jax.tree.map(lambda x: x.reshape(num_groups, x.shape[0] // num_groups, *x.shape[1:]), tree)


def join_by_group(*parts: Any) -> Any:
    """Parts [groups, n_i, ...] -> [groups * sum of n_i, ...]: of each group the first part, then the second."""
    joined = jax.tree.map(lambda *xs: jnp.concatenate(xs, axis=1), *parts)
    return jax.tree.map(lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), joined)
