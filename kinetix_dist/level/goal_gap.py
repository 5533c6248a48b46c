"""Distance from green to blue, from edge to edge. A level is solved when they touch, which `env/outcome.py` judges by
the contacts of every physics step; the dense reward goes by the distance of their centres.

    pairs = goal_pairs(level)                   # numpy, once per level
    gap = goal_gap(pairs, position, angle)      # of the shapes now, in any program
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist.level.level import Level, Role
from kinetix_dist.level.overlap import surface_distance, world_corners
from kinetix_dist.level.statistics import own_corners


class GoalPairs(NamedTuple):
    """Each green shape of a level with each blue one: P pairs, of levels of files one."""

    slots: Array  # [P, 2] int32, green and blue
    corners: Array  # [P, 2, V, 2] m, in the frame of the shape
    radius: Array  # [P, 2] m, 0 of polygons


def goal_pairs(level: Level) -> GoalPairs:
    """Pairs of one level (numpy)."""
    active, roles = np.asarray(level.scene.shapes.active), np.asarray(level.shape_role)
    green, blue = (np.flatnonzero(active & (roles == role)) for role in (Role.GREEN, Role.BLUE))
    slots = np.stack(np.meshgrid(green, blue, indexing="ij"), axis=-1).reshape(-1, 2).astype(np.int32)
    corners, radius = (np.asarray(part) for part in own_corners(level))
    return GoalPairs(slots, corners[slots], radius[slots])


def goal_gap(pairs: GoalPairs, position: Array, angle: Array) -> Array:
    """Distance (m) of the closest pair, of shapes at `position` [n, 2] and `angle` [n]: 0 where the two touch or
    overlap, and in a level without a pair."""
    if not len(pairs.slots):
        return jnp.zeros(())
    corners = world_corners(position[pairs.slots], angle[pairs.slots], pairs.corners)
    gaps = jax.vmap(surface_distance)(corners[:, 0], pairs.radius[:, 0], corners[:, 1], pairs.radius[:, 1])
    return jnp.maximum(gaps.min(), 0.0)
