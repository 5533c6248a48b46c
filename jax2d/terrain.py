"""Ground from a line of points: fixed tiles whose joints nothing feels that slides or rolls over them.

A tile has the segment between two points as its face, and lies to the right of the line's direction: below a line that
runs to the right. What moves along the line would catch on the sides of tiles if it met them. So no side reaches the
surface: in a valley the face goes on below the neighbour's surface, and at a crest the beginning of the neighbour's
face is a face of the tile too. (Ghost vertices of chain shapes, as geometry: what is near a joint sees the same faces,
whichever tile it meets.)
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from jax2d.builder_checks import SAME_POINT, SMALLEST_AREA_M2, SceneError, check_polygon
from jax2d.xla.vec2 import cross

ROOT_SHARE = 0.5  # of the thickness, or of the neighbour's length: how far tiles reach over their joints
LARGEST_TURN = math.radians(80)  # at a joint: a face and what of its neighbour's it reaches over make no corner beyond


def tiles(points: np.ndarray, thickness: float) -> Iterator[np.ndarray]:
    """Corners [k, 2] m of each tile, counter-clockwise. points [N, 2] m with which nothing is `wrong_with`."""
    steps = np.diff(points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    along = steps / lengths[:, None]
    is_valley = cross(along[:-1], along[1:]) >= 0
    for i, direction in enumerate(along):
        top = [points[i], points[i + 1]]
        if i > 0:
            reach = ROOT_SHARE * min(thickness, lengths[i - 1])
            top[:1] = [top[0] - reach * direction] if is_valley[i - 1] else [top[0] - reach * along[i - 1], top[0]]
        if i + 1 < len(along):
            reach = ROOT_SHARE * min(thickness, lengths[i + 1])
            top[-1:] = [top[-1] + reach * direction] if is_valley[i] else [top[-1], top[-1] + reach * along[i + 1]]
        down = thickness * np.array([direction[1], -direction[0]])
        yield np.array([top[0] + down, top[-1] + down, *top[::-1]])


def wrong_with(points: np.ndarray, thickness: float) -> str | None:
    """Returns the fault of a line [N, 2] m of terrain and its remedy, in one line; None for a good one."""
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        return f"terrain has points of shape {points.shape}; give a list of two or more (x, y) points"
    steps = np.diff(points, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    if (lengths <= SAME_POINT * lengths.max()).any():
        i = int(np.argmin(lengths))
        return f"points {i} and {i + 1} of the terrain are the same; drop one of them"
    turns = np.arctan2(cross(steps[:-1], steps[1:]), (steps[:-1] * steps[1:]).sum(-1))
    if (np.abs(turns) > LARGEST_TURN).any():
        i = int(np.argmax(np.abs(turns))) + 1
        return (
            f"the terrain folds back at point {i}, by {math.degrees(abs(turns[i - 1])):.0f} degrees; it may turn by "
            f"{math.degrees(LARGEST_TURN):.0f} at a point: add points in between"
        )
    for i in range(len(steps)):
        for j in range(i + 2, len(steps)):
            if _segments_cross(points[i : i + 2], points[j : j + 2]):
                return f"the terrain crosses itself: points {i} to {i + 1} and {j} to {j + 1}; make two terrains of it"
    for i, tile in enumerate(tiles(points, thickness)):
        for j in range(len(steps)):
            if i != j and _segments_cross(tile[:2], points[j : j + 2]):
                return (
                    f"the tile below points {i} and {i + 1} of the terrain comes out at points {j} and {j + 1}; give "
                    f"less thickness than {thickness:g}"
                )
    return _no_polygon(points, thickness)


def _no_polygon(points: np.ndarray, thickness: float) -> str | None:
    """Fault of the first tile that a builder would refuse; None without one."""
    for i, (tile, at) in enumerate(zip(tiles(points, thickness), points)):
        try:
            check_polygon(tile - at, len(tile))
        except SceneError as error:
            return (
                f"with a thickness of {thickness:g} the tile below points {i} and {i + 1} of the terrain makes no "
                f"polygon ({str(error).partition(';')[0]}); give a thickness nearer to their distance, and tiles of at "
                f"least {SMALLEST_AREA_M2:g} m^2"
            )
    return None


def _segments_cross(one: np.ndarray, other: np.ndarray) -> bool:
    """Touching counts. one, other [2, 2] m: the ends of each."""

    def sides(line: np.ndarray, points: np.ndarray) -> list[float]:
        return [float(cross(line[1] - line[0], point - line[0])) for point in points]

    (a, b), (c, d) = sides(one, other), sides(other, one)
    if a == b == 0:  # on one line
        axis = int(np.argmax(np.abs(one[1] - one[0])))
        spans = [sorted((line[0][axis], line[1][axis])) for line in (one, other)]
        return spans[0][0] <= spans[1][1] and spans[1][0] <= spans[0][1]
    return a * b <= 0 and c * d <= 0
