"""Pictures of a world, without a display, a window system or a GPU: numpy in, RGB pixels out.

Every primitive is convex, so each is filled from its signed distance in pixels (negative inside):
coverage = clip(0.5 - distance, 0, 1), which gives smooth edges. Nothing here knows the task: a shape is
painted `palette[roles[shape]]`, fixed shapes darker, and a world without roles is grey.

    image = draw(scene, state, roles=roles)          # uint8 [height, width, 3]
    images.write_png("world.png", image)
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from jax2d.scene import JointKind, Scene

Colour = tuple[int, int, int]
Box = tuple[float, float, float, float]  # lowest x, lowest y, highest x, highest y, in m

ROLE_PALETTE: tuple[Colour, ...] = (
    (176, 178, 186),  # no role
    (70, 178, 98),  # green
    (58, 118, 224),  # blue
    (224, 68, 64),  # red
)
MOTOR_PALETTE: tuple[Colour, ...] = ((240, 150, 40), (150, 90, 210), (30, 160, 170), (210, 80, 150))
THRUSTER_PALETTE: tuple[Colour, ...] = ((255, 140, 20), (200, 60, 200))
BACKGROUND: Colour = (250, 250, 248)
INK: Colour = (52, 54, 62)
FLAME_CORE: Colour = (255, 236, 140)
FIXED_SHADE = 0.62  # fixed shapes are this much darker than movable ones of the same role
KINEMATIC_SHADE = 0.8  # and kinematic ones
WELD_ANGLES = (0.25 * np.pi, 0.75 * np.pi)  # rad, of the two arms of the cross of a weld
BELT_ARROW_M = 0.1  # arrows along the outline of what has a surface speed, one every
BELT_SPACING_M = 0.4
OUTLINE_SHADE = 0.6

DEFAULT_VIEW: Box = (-0.12, -0.12, 5.12, 5.12)  # the 5 x 5 m box with a rim of its walls
LINE_WIDTH = 1.6  # pixels, of outlines and of lines
WELD_WIDTH = 2.4
THRUSTER_LENGTH_M = 0.16
NOZZLE_SHARE = 0.35  # half the width of a nozzle, of its length
JOINT_RADIUS_M = 0.06
MOTOR_SHARE = 0.5  # radius of what says that a hinge has a motor, of JOINT_RADIUS_M
SLIDER_SHARE = 0.7  # of the block of a slider
SPOKE_SHARE = 0.9  # length of the spoke of a disc, of its radius
RAIL_M = 0.5  # of a slider without limits, to each side
COIL_M = 0.05  # half the width of a spring
NUM_COILS = 6


def shape_colours(scene: Scene, roles: Any = None, palette: Sequence[Colour] = ROLE_PALETTE) -> np.ndarray:
    """Colour of every shape: that of its role, darker when the shape is kinematic or fixed. [n, 3] uint8."""
    num_shapes = np.asarray(scene.shapes.active).shape[0]
    roles = np.zeros(num_shapes, int) if roles is None else np.asarray(roles).astype(int)
    if roles.shape != (num_shapes,) or roles.min() < 0 or roles.max() >= len(palette):
        raise ValueError(
            f"roles has shape {roles.shape} and values {roles.min()}..{roles.max()}; "
            f"give one role in 0..{len(palette) - 1} for each of the {num_shapes} shapes"
        )
    has_no_mass = np.asarray(scene.shapes.inverse_mass) == 0
    shade_without_mass = np.where(scene.shapes.kinematic, KINEMATIC_SHADE, FIXED_SHADE)
    shade = np.where(has_no_mass, shade_without_mass, 1.0)[:, None]
    return (np.asarray(palette, float)[roles] * shade).astype(np.uint8)


def rotate(vector: np.ndarray, angle: Any) -> np.ndarray:
    """Turns `[..., 2]` vectors counter-clockwise by angles (rad) that broadcast against `[...]`."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def joint_positions(scene: Scene, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Where each joint holds its body a, world frame. position [..., n, 2], angle [..., n] -> [..., J, 2] m."""
    body = np.asarray(scene.joints.a)
    return position[..., body, :] + rotate(np.asarray(scene.joints.anchor_a), angle[..., body])


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


def draw(
    scene: Scene,
    state: Any,
    roles: Any = None,
    *,
    palette: Sequence[Colour] = ROLE_PALETTE,
    thrust: Any = None,
    motor_colours: Any = None,
    thruster_colours: Any = None,
    view: Box = DEFAULT_VIEW,
    pixels_per_metre: float = 100.0,
    trails: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Draws one world. Returns uint8 [height, width, 3].

    Args:
      scene: one world (no leading axis).
      state: anything with `position` [n, 2] and `angle` [n]: a State, or a level at its start.
      roles: [n] index into `palette`; None paints all shapes as role 0.
      thrust: [T] 0..1, how much each thruster fires; None draws no flames.
      motor_colours, thruster_colours: [J] and [T] indices into MOTOR_PALETTE and THRUSTER_PALETTE, which controls
        drive what; None paints all motors alike, and nozzles in ink.
      view: the part of the world to show, m.
      trails: paths [k, 2] m to draw over the shapes, fading in (where something has been).
    """
    scene = _as_numpy(scene)
    position, angle = np.asarray(state.position, float), np.asarray(state.angle, float)
    if position.ndim != 2:
        raise ValueError(f"draw shows one world; position has shape {position.shape}: select one with index_worlds")
    canvas = _Canvas.blank(view, pixels_per_metre)
    colours = shape_colours(scene, roles, palette).astype(float)
    _draw_shapes(canvas, scene, position, angle, colours)
    for trail in trails:
        for k, (a, b) in enumerate(itertools.pairwise(np.asarray(trail, float))):
            canvas.line(a, b, INK, 2.0, opacity=0.15 + 0.45 * k / len(trail))
    _draw_thrusters(canvas, scene, position, angle, thrust, thruster_colours)
    _draw_springs(canvas, scene, position, angle)
    _draw_joints(canvas, scene, position, angle, motor_colours)
    return np.rint(canvas.pixels).astype(np.uint8)


def _as_numpy(scene: Scene) -> Scene:
    return jax.tree.map(np.asarray, scene)


def _draw_shapes(canvas: _Canvas, scene: Scene, position: np.ndarray, angle: np.ndarray, colours: np.ndarray) -> None:
    num_polygons = scene.shapes.vertices.shape[0]
    # Fixed shapes first: what moves stays visible where a wall and a body overlap.
    for i in sorted(np.flatnonzero(scene.shapes.active), key=lambda i: scene.shapes.inverse_mass[i] > 0):
        outline = colours[i] * OUTLINE_SHADE
        if i < num_polygons:
            body = scene.shapes.vertices[i, : scene.shapes.num_vertices[i]]
            canvas.polygon(position[i] + rotate(body, angle[i]), colours[i], outline=outline)
        else:
            radius = float(scene.shapes.radius[i - num_polygons])
            canvas.disc(position[i], radius, colours[i], outline=outline)
            rim = position[i] + rotate(np.array([radius * SPOKE_SHARE, 0.0]), angle[i])
            canvas.line(position[i], rim, outline, LINE_WIDTH)  # a spoke: how far it has rolled
        if i < len(scene.shapes.surface_speed) and scene.shapes.surface_speed[i] != 0:
            for arrow in belt_arrows(scene, i):
                canvas.polygon(position[i] + rotate(arrow, angle[i]), outline)


def belt_arrows(scene: Scene, i: int) -> list[np.ndarray]:
    """Arrows [3, 2] m in the frame of shape i along its outline, to where its surface goes."""
    shapes = scene.shapes
    num_polygons = shapes.vertices.shape[0]
    if i < num_polygons:
        corners = np.asarray(shapes.vertices[i, : shapes.num_vertices[i]], float)
    else:
        turns = np.linspace(0, 2 * np.pi, 8, endpoint=False)
        corners = rotate(np.array([float(shapes.radius[i - num_polygons]), 0.0]), turns)
    arrows = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = np.linalg.norm(end - start)
        along = (end - start) / length * -np.sign(shapes.surface_speed[i])  # clockwise, against the order of corners
        inward = np.array([start[1] - end[1], end[0] - start[0]]) / length
        count = max(1, int(length / BELT_SPACING_M))
        for share in (np.arange(count) + 0.5) / count:
            at = start + (end - start) * share + inward * 0.6 * BELT_ARROW_M
            side = 0.5 * BELT_ARROW_M * rotate(along, np.pi / 2)
            arrows.append(np.stack([at + along * BELT_ARROW_M, at + side, at - side]))
    return arrows


def slider_outline(scene: Scene, position: np.ndarray, angle: np.ndarray, k: int) -> np.ndarray:
    """Ends of the rail of prismatic joint k in the world, [2, 2] m: between its limits, or a body's length to each side
    of where b is."""
    joints = scene.joints
    a, b = joints.a[k], joints.b[k]
    origin = position[a] + rotate(np.asarray(joints.anchor_a, float)[k], angle[a])
    axis = rotate(np.array([1.0, 0.0]), angle[a] + float(joints.axis_angle[k]))
    if joints.has_limits[k]:
        reach = np.array([joints.lower_limit[k], joints.upper_limit[k]], float)
    else:
        at = position[b] + rotate(np.asarray(joints.anchor_b, float)[k], angle[b])
        reach = float((at - origin) @ axis) + np.array([-RAIL_M, RAIL_M])
    return origin + reach[:, None] * axis


def thruster_outline(scene: Scene, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Nozzle [3, 2] and flame [3, 2] of thruster k in the frame of its body, m: the push is from base to tip."""
    at, angle = np.asarray(scene.thrusters.position, float)[k], float(np.asarray(scene.thrusters.angle)[k])
    half = NOZZLE_SHARE * THRUSTER_LENGTH_M
    nozzle = np.array([[0.0, -half], [THRUSTER_LENGTH_M, 0.0], [0.0, half]])
    flame = np.array([[0.0, half], [-1.7 * THRUSTER_LENGTH_M, 0.0], [0.0, -half]])
    return at + rotate(nozzle, angle), at + rotate(flame, angle)


def _draw_thrusters(
    canvas: _Canvas, scene: Scene, position: np.ndarray, angle: np.ndarray, thrust: Any, colours: Any
) -> None:
    for k in np.flatnonzero(scene.thrusters.active):
        body = scene.thrusters.body[k]
        nozzle, flame = (position[body] + rotate(part, angle[body]) for part in thruster_outline(scene, k))
        fire = 0.0 if thrust is None else float(np.asarray(thrust)[k])
        if fire > 0:
            base = (flame[0] + flame[2]) / 2
            canvas.polygon(base + (flame - base) * fire, THRUSTER_PALETTE[0])
            canvas.polygon(base + (flame - base) * 0.5 * fire, FLAME_CORE)
        canvas.polygon(nozzle, INK if colours is None else THRUSTER_PALETTE[int(colours[k])])


def spring_outline(scene: Scene, position: np.ndarray, angle: np.ndarray, k: int) -> np.ndarray:
    """The line of spring k in the world, [p, 2] m: a zigzag where it has stiffness, else straight."""
    springs = scene.springs
    start, end = (
        position[body] + rotate(np.asarray(local, float), angle[body])
        for body, local in ((springs.a[k], springs.anchor_a[k]), (springs.b[k], springs.anchor_b[k]))
    )
    along = end - start
    length = float(np.linalg.norm(along))
    if springs.stiffness[k] == 0 or length == 0:
        return np.stack([start, end])
    share = np.concatenate([[0], np.linspace(0.1, 0.9, 2 * NUM_COILS + 1), [1]])
    side = np.concatenate([[0, 0], np.tile([COIL_M, -COIL_M], NUM_COILS)[1:], [0, 0]])
    across = np.array([-along[1], along[0]]) / length
    return start + share[:, None] * along + side[:, None] * across


def _draw_springs(canvas: _Canvas, scene: Scene, position: np.ndarray, angle: np.ndarray) -> None:
    for k in np.flatnonzero(scene.springs.active):
        outline = spring_outline(scene, position, angle, k)
        for start, end in itertools.pairwise(outline):
            canvas.line(start, end, INK, LINE_WIDTH)
        for end in (outline[0], outline[-1]):
            canvas.disc(end, 0.4 * JOINT_RADIUS_M, INK)


def _draw_joints(canvas: _Canvas, scene: Scene, position: np.ndarray, angle: np.ndarray, colours: Any) -> None:
    places = joint_positions(scene, position, angle)
    for k in np.flatnonzero(scene.joints.active):
        motor = MOTOR_PALETTE[0 if colours is None else int(colours[k])]
        if scene.joints.is_kind(JointKind.PRISMATIC)[k]:  # a slider: a rail on a, and a block on it
            for start, end in itertools.pairwise(slider_outline(scene, position, angle, k)):
                canvas.line(start, end, INK, LINE_WIDTH)
            canvas.disc(places[k], JOINT_RADIUS_M * SLIDER_SHARE, motor if scene.joints.motor_on[k] else INK)
        elif scene.joints.is_kind(JointKind.FIXED)[k]:  # a weld: a small cross
            for turn in WELD_ANGLES:
                arm = rotate(np.array([JOINT_RADIUS_M, 0.0]), turn)
                canvas.line(places[k] - arm, places[k] + arm, INK, WELD_WIDTH)
        else:  # a hinge: a disc, coloured at the middle when a motor drives it
            canvas.disc(places[k], JOINT_RADIUS_M, (255, 255, 255), outline=INK)
            if scene.joints.motor_on[k]:
                canvas.disc(places[k], JOINT_RADIUS_M * MOTOR_SHARE, motor)
