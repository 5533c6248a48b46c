"""Worlds with any number of shapes, for measuring how cost grows: bodies apart from each other, and in a heap.

All shapes of a world are active. Bodies alternate between boxes and balls, about 0.6 m large, dropped from up to half a
metre so that no two land at the same moment.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jax2d import BuiltWorld, Capacity, SceneBuilder

BODY_M = 0.6
SPACING_M = 1.5  # from centre to centre of bodies that are to stay apart
BODIES_PER_PLATFORM = 15
MIN_SHAPES = 4


def capacity_of(num_shapes: int) -> Capacity:
    """Polygons and circles by halves, two polygons more for floors and walls; no joints or thrusters."""
    if num_shapes < MIN_SHAPES:
        raise ValueError(f"a world of {num_shapes} shapes was asked for; these worlds have {MIN_SHAPES} or more")
    return Capacity(polygons=num_shapes // 2 + 1, circles=(num_shapes + 1) // 2 - 1, joints=0, thrusters=0)


def row(num_shapes: int, seed: int = 0) -> BuiltWorld:
    """Bodies in one row on one floor under all of them."""
    layout = _Layout(num_shapes, seed)
    bodies = num_shapes - 1
    layout.add_floor(0.0, 0.0, width=SPACING_M * (bodies + 1))
    for i in range(bodies):
        layout.add_body((i - 0.5 * (bodies - 1)) * SPACING_M, 0.0)
    return layout.builder.build()


def platforms(num_shapes: int, seed: int = 0) -> BuiltWorld:
    """Floors above each other, 15 bodies on each."""
    layout = _Layout(num_shapes, seed)
    left = num_shapes
    storey = 0
    while left > 1:
        bodies = min(BODIES_PER_PLATFORM, left - 1)
        layout.add_floor(0.0, 2.0 * storey, width=SPACING_M * (BODIES_PER_PLATFORM + 1))
        for i in range(bodies):
            layout.add_body((i - 0.5 * (bodies - 1)) * SPACING_M, 2.0 * storey)
        left -= bodies + 1
        storey += 1
    if left:
        layout.add_body(0.0, 2.0 * storey)
    return layout.builder.build()


def heap(num_shapes: int, seed: int = 0) -> BuiltWorld:
    """Bodies that fall into a box and pile up there, about twice as wide as high."""
    layout = _Layout(num_shapes, seed)
    bodies = num_shapes - 3
    columns = max(2, round((2 * bodies) ** 0.5))
    width = columns * BODY_M * 1.2
    layout.add_floor(0.0, 0.0, width=width + 2)
    for side in (-1, 1):
        layout.add_wall(side * (0.5 * width + 0.5), height=2 * width + 4)
    for i in range(bodies):
        layout.add_body((i % columns - 0.5 * (columns - 1)) * BODY_M * 1.15, (i // columns) * BODY_M * 1.3)
    return layout.builder.build()


SCENES: dict[str, Callable[..., BuiltWorld]] = {"row": row, "platforms": platforms, "heap": heap}


class _Layout:
    """Places floors, walls and bodies until a world of `num_shapes` shapes is full."""

    def __init__(self, num_shapes: int, seed: int) -> None:
        self.builder = SceneBuilder(capacity_of(num_shapes))
        self._random = np.random.default_rng(seed)
        self._boxes = self._balls = 0

    def add_floor(self, x: float, y: float, *, width: float) -> None:
        """A fixed box whose upper side is at y."""
        self._boxes += 1
        self.builder.add_box(width=width, height=0.5, position=(x, y - 0.25), fixed=True)

    def add_wall(self, x: float, *, height: float) -> None:
        self._boxes += 1
        self.builder.add_box(width=1.0, height=height, position=(x, 0.5 * height), fixed=True)

    def add_body(self, x: float, y: float) -> None:
        """A body whose lower end is up to half a metre above y."""
        size = BODY_M * self._random.uniform(0.8, 1.0)
        position = (x, y + 0.5 * BODY_M + self._random.uniform(0.0, 0.5))
        if self._is_ball_next():
            self._balls += 1
            self.builder.add_circle(radius=0.5 * size, position=position, restitution=0.2)
        else:
            self._boxes += 1
            self.builder.add_box(width=size, height=size, position=position, restitution=0.2)

    def _is_ball_next(self) -> bool:
        """The two kinds alternate while there is room for both."""
        capacity = self.builder.capacity
        if self._balls < capacity.circles and self._balls <= self._boxes:
            return True
        return self._boxes >= capacity.polygons
