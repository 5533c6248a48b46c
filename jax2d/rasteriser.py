"""Pixels of a display list, without a display, a window system or a GPU: numpy in, RGB out.

Every primitive is convex, so each is filled from its signed distance in pixels (negative inside):
coverage = clip(0.5 - distance, 0, 1), which gives smooth edges.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from jax2d.display_list import DISC, POLYGON, SHAPE, DisplayList, Primitive, world_points
from jax2d.palette import BACKGROUND, INK, LINE_WIDTH

Box = tuple[float, float, float, float]  # lowest x, lowest y, highest x, highest y, in m

DEFAULT_VIEW: Box = (-0.12, -0.12, 5.12, 5.12)  # the 5 x 5 m box with a rim of its walls
TRAIL_WIDTH = 2.0  # pixels
FIRST_OPACITY, MORE_OPACITY = 0.15, 0.45  # of a trail, from its start to its end


def rasterise(
    display: DisplayList,
    position: np.ndarray,
    angle: np.ndarray,
    *,
    thrust: Any = None,
    view: Box = DEFAULT_VIEW,
    pixels_per_metre: float = 100.0,
    trails: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Paints one world. Returns uint8 [height, width, 3].

    position [n, 2] m and angle [n] rad of every shape; thrust [T] 0..1, None: no flames; trails: paths [k, 2] m over
    the shapes and under the rest, fading in.
    """
    canvas = _Canvas.blank(view, pixels_per_metre)
    over = [primitive.part[0] != SHAPE for primitive in display.primitives]
    num_under = over.index(True) if True in over else len(over)
    for primitive in display.primitives[:num_under]:
        _paint(canvas, primitive, position, angle, thrust)
    for trail in trails:
        for k, (a, b) in enumerate(itertools.pairwise(np.asarray(trail, float))):
            canvas.line(a, b, INK, TRAIL_WIDTH, opacity=FIRST_OPACITY + MORE_OPACITY * k / len(trail))
    for primitive in display.primitives[num_under:]:
        _paint(canvas, primitive, position, angle, thrust)
    return np.rint(canvas.pixels).astype(np.uint8)


def _paint(canvas: _Canvas, primitive: Primitive, position: np.ndarray, angle: np.ndarray, thrust: Any) -> None:
    points = world_points(primitive, position, angle, thrust)
    if points is None:
        return
    if primitive.kind == POLYGON:
        canvas.polygon(points, primitive.fill, outline=primitive.outline)
    elif primitive.kind == DISC:
        canvas.disc(points[0], primitive.radius, primitive.fill, outline=primitive.outline)
    else:
        for start, end in itertools.pairwise(points):
            canvas.line(start, end, primitive.fill, primitive.width)


def check_view(view: Box) -> None:
    """Raises ValueError for what is no part of a world."""
    box = np.asarray(view, np.float64) if np.shape(view) == (4,) else np.zeros(4)
    if not (np.isfinite(box).all() and (box[:2] < box[2:]).all()):
        raise ValueError(
            f"view is {view}; give lowest x, lowest y, highest x, highest y in m, the lowest below the highest"
        )


@dataclasses.dataclass(frozen=True)
class _Canvas:
    """A picture in the making: float colours, and the map from metres to pixels (y up to rows down)."""

    pixels: np.ndarray  # [height, width, 3] 0..255
    view: Box
    scale: float  # pixels per metre

    @staticmethod
    def blank(view: Box, scale: float) -> _Canvas:
        check_view(view)
        width, height = (round((view[2 + axis] - view[axis]) * scale) for axis in (0, 1))
        if width < 1 or height < 1:
            raise ValueError(f"view {view} at {scale} pixels a metre has no pixels; make either larger")
        return _Canvas(np.tile(np.asarray(BACKGROUND, float), (height, width, 1)), view, scale)

    def to_pixels(self, point: np.ndarray) -> np.ndarray:
        """World metres to (column, row), pixel centres at halves."""
        return np.stack([(point[..., 0] - self.view[0]), (self.view[3] - point[..., 1])], axis=-1) * self.scale

    def fill(
        self,
        distance: Callable[[np.ndarray], np.ndarray],
        low: np.ndarray,
        high: np.ndarray,
        colour: Sequence[float],
        *,
        outline: Sequence[float] | None = None,
        outline_width: float = LINE_WIDTH,
        opacity: float = 1.0,
    ) -> None:
        """Paints where `distance(points [h, w, 2])` < 0, looking at the box low..high only (all in pixels)."""
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            return  # a world that has diverged has nowhere to be painted
        height, width = self.pixels.shape[:2]
        first = np.clip(np.floor(low).astype(int) - 1, 0, [width, height])
        last = np.clip(np.ceil(high).astype(int) + 1, 0, [width, height])
        if (first >= last).any():
            return
        columns, rows = np.meshgrid(np.arange(first[0], last[0]) + 0.5, np.arange(first[1], last[1]) + 0.5)
        signed = distance(np.stack([columns, rows], axis=-1))
        target = self.pixels[first[1] : last[1], first[0] : last[0]]
        paint = np.asarray(colour, float)
        if outline is not None:
            edge = np.clip(signed + outline_width + 0.5, 0.0, 1.0)[..., None]
            paint = paint * (1 - edge) + np.asarray(outline, float) * edge
        cover = opacity * np.clip(0.5 - signed, 0.0, 1.0)[..., None]
        target[...] = target * (1 - cover) + paint * cover

    def polygon(self, vertices: np.ndarray, colour: Sequence[float], **kwargs: Any) -> None:
        """A convex polygon, counter-clockwise in the world (metres)."""
        corners = self.to_pixels(vertices)
        edges = np.roll(corners, -1, axis=0) - corners
        lengths = np.linalg.norm(edges, axis=-1)
        corners, edges = corners[lengths > 0], edges[lengths > 0]  # unused vertex slots repeat the last vertex
        if len(corners) < 3:
            return
        # Rows run down, so a world counter-clockwise loop is clockwise here: outward is to the right of an edge.
        outward = np.stack([-edges[:, 1], edges[:, 0]], axis=-1) / lengths[lengths > 0][:, None]

        def distance(points: np.ndarray) -> np.ndarray:
            return np.max([(points - corner) @ normal for corner, normal in zip(corners, outward, strict=True)], axis=0)

        self.fill(distance, corners.min(0), corners.max(0), colour, **kwargs)

    def disc(self, centre: np.ndarray, radius: float, colour: Sequence[float], **kwargs: Any) -> None:
        """A disc; centre and radius in metres."""
        middle, reach = self.to_pixels(centre), radius * self.scale
        self.fill(
            lambda p: np.linalg.norm(p - middle, axis=-1) - reach, middle - reach, middle + reach, colour, **kwargs
        )

    def line(self, a: np.ndarray, b: np.ndarray, colour: Sequence[float], width: float, **kwargs: Any) -> None:
        """A line with round ends; ends in metres, width in pixels."""
        start, along = self.to_pixels(a), self.to_pixels(b) - self.to_pixels(a)
        squared = max(float(along @ along), 1e-12)

        def distance(points: np.ndarray) -> np.ndarray:
            share = np.clip((points - start) @ along / squared, 0.0, 1.0)[..., None]
            return np.linalg.norm(points - start - share * along, axis=-1) - width / 2

        ends = np.stack([start, start + along])
        self.fill(distance, ends.min(0) - width, ends.max(0) + width, colour, **kwargs)
