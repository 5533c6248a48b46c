"""The box every level is played in, and a level with nothing else in it.

Walls are the first four polygons of every level: floor, left wall, right wall, ceiling. They are fixed, a few metres
thick so that nothing fast can be on the far side of one after a step, and touch everything (collision mode 2). The
free space is 0..5 m wide and 0.4..5 m high, as in the public levels.
"""

from __future__ import annotations

import numpy as np

from jax2d.fields import empty
from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Level

FLOOR_TOP_M = 0.4  # height of the ground above the origin of the world
WALL_NAMES = ("floor", "left_wall", "right_wall", "ceiling")  # polygon slots 0-3
COLLIDES_WITH_ALL = 2  # collision mode of walls
COLLIDES_NORMALLY = 1
PASSES_THROUGH = 0  # passes through shapes of mode 0 and 1, is stopped by mode 2

_MIDDLE_M = 0.5 * WORLD_SIZE_M
_SLAB_HALF_HEIGHT_M = 5.2  # floor and ceiling, deeper than a body can move in a step
WALL_CENTRES_M = np.array(
    [
        [_MIDDLE_M, FLOOR_TOP_M - _SLAB_HALF_HEIGHT_M],
        [-_MIDDLE_M, _MIDDLE_M],
        [WORLD_SIZE_M + _MIDDLE_M, _MIDDLE_M],
        [_MIDDLE_M, WORLD_SIZE_M + _SLAB_HALF_HEIGHT_M],
    ],
    np.float32,
)
WALL_HALF_EXTENTS_M = np.array(
    [
        [_MIDDLE_M, _SLAB_HALF_HEIGHT_M],
        [_MIDDLE_M, _MIDDLE_M],
        [_MIDDLE_M, _MIDDLE_M],
        [_MIDDLE_M, _SLAB_HALF_HEIGHT_M],
    ],
    np.float32,
)
_CORNERS = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]], np.float32)  # counter-clockwise
GRAVITY_M_S2 = (0.0, -9.81)


def pad_vertices(vertices: np.ndarray, capacity: Capacity) -> np.ndarray:
    """`[k, 2]` corners as `[V, 2]`: unused slots repeat the last corner."""
    fill = np.repeat(vertices[-1:], capacity.vertices - len(vertices), axis=0)
    return np.concatenate([vertices, fill]).astype(np.float32)


def empty_level(capacity: Capacity) -> Level:
    """A level (numpy arrays) of the four walls alone; every other slot is inactive."""
    if capacity.polygons < NUM_WALLS or capacity.vertices < 4:
        raise ValueError(
            f"a level needs {NUM_WALLS} polygons of 4 corners for its walls; capacity has "
            f"{capacity.polygons} polygons of at most {capacity.vertices}"
        )
    level = empty(Level, capacity.sizes)
    shapes, walls = level.scene.shapes, slice(NUM_WALLS)
    shapes.active[walls] = True
    shapes.vertices[walls] = [pad_vertices(_CORNERS * half, capacity) for half in WALL_HALF_EXTENTS_M]
    shapes.num_vertices[walls] = len(_CORNERS)
    level.position[walls] = WALL_CENTRES_M
    level.collision_mode[walls] = COLLIDES_WITH_ALL
    level.scene.gravity[:] = GRAVITY_M_S2
    return level
