"""Picture of a world as a list of primitives in the order of painting: numpy only, no pixels.

    display = display_list(scene, roles)                    once a scene
    points = world_points(primitive, position, angle)       where a primitive is in one picture

A primitive is given in the frame of a body, so that the list is constant; a picture takes the pose of every body and
how much every thruster fires besides. Nothing here knows the task: a shape has the colour `palette[roles[shape]]`,
fixed shapes darker, and a world without roles is grey. The rasteriser, rerun and the pages all draw this list.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any, TypedDict

import numpy as np

from jax2d.palette import (
    BELT_ARROW_M,
    BELT_SPACING_M,
    COIL_M,
    CORE_SHARE,
    FIXED_SHADE,
    FLAME_CORE,
    FLAME_SHARE,
    HINGE,
    INK,
    JOINT_RADIUS_M,
    KINEMATIC_SHADE,
    LINE_WIDTH,
    MOTOR_PALETTE,
    MOTOR_SHARE,
    NOZZLE_SHARE,
    NUM_COILS,
    OUTLINE_SHADE,
    RAIL_M,
    ROLE_PALETTE,
    SLIDER_SHARE,
    SPOKE_SHARE,
    SPRING_END_SHARE,
    THRUSTER_LENGTH_M,
    THRUSTER_PALETTE,
    WELD_ANGLES,
    WELD_WIDTH,
    Colour,
)
from jax2d.scene import JointKind, Scene

POLYGON, DISC, LINE, RAIL, SPRING = KINDS = ("polygon", "disc", "line", "rail", "spring")
SHAPE, JOINT, THRUSTER, SPRING_PART = "shape", "joint", "thruster", "spring"
BELT_CORNERS = 8  # of a disc, between which the arrows of its belt lie


@dataclasses.dataclass(frozen=True, kw_only=True, slots=True)
class Primitive:
    """One thing to paint. Points are in the frame of `body`; colours 0..255, not always whole."""

    kind: str  # of KINDS
    part: tuple[str, int]  # what it belongs to: ("shape", 4), ("joint", 0), ("thruster", 1), ("spring", 0)
    body: int
    points: np.ndarray  # [k, 2] m: corners (convex, counter-clockwise), centre, ends, or the start of rail and spring
    fill: Sequence[float]
    outline: Sequence[float] | None = None  # inside the edge, LINE_WIDTH pixels wide
    radius: float = 0.0  # m, of a disc
    width: float = 0.0  # pixels, of lines, rails and springs
    upright: np.ndarray | None = None  # [2] m: only this point turns with the body, `points` are offsets in the world
    thruster: int | None = None  # a flame: shown while this thruster fires, longer the more it does,
    scale_from: np.ndarray | None = None  # [2] m, from this point on
    size: float = 1.0  # of the flame at full thrust
    other: int = 0  # of rail and spring: the body at the other end,
    other_point: np.ndarray | None = None  # [2] m, in its frame
    angle: float = 0.0  # rad, of a rail, frame of `body`
    reach: float = 0.0  # m, of a rail to each side of `other_point`; half the width of the coils of a spring
    coils: int = 0  # of a spring; 0: a straight line

    def to_json(self) -> dict[str, Any]:
        """Returns JSON types, without fields that a primitive of its kind does not have."""
        document: dict[str, Any] = {
            "kind": self.kind,
            "part": list(self.part),
            "body": self.body,
            "points": self.points.tolist(),
            "fill": list(self.fill),
        }
        if self.outline is not None:
            document["outline"] = list(self.outline)
        if self.kind == DISC:
            document["radius"] = self.radius
        elif self.kind != POLYGON:
            document["width"] = self.width
        if self.upright is not None:
            document["upright"] = self.upright.tolist()
        if self.thruster is not None and self.scale_from is not None:
            document |= {"thruster": self.thruster, "scale_from": self.scale_from.tolist(), "size": self.size}
        if self.other_point is not None:
            document |= {"other": self.other, "other_point": self.other_point.tolist(), "reach": self.reach}
            document |= {"angle": self.angle} if self.kind == RAIL else {"coils": self.coils}
        return document


@dataclasses.dataclass(frozen=True, kw_only=True)
class DisplayList:
    """The primitives of one world, in the order of painting. Those of shapes come first."""

    num_shapes: int
    primitives: tuple[Primitive, ...]

    def to_json(self) -> dict[str, Any]:
        return {"num_shapes": self.num_shapes, "primitives": [primitive.to_json() for primitive in self.primitives]}


class ColourKeywords(TypedDict, total=False):
    """Keywords of `display_list`, which says what they mean."""

    palette: Sequence[Colour]
    motor_colours: Any
    thruster_colours: Any


def display_list(
    scene: Scene,
    roles: Any = None,
    *,
    palette: Sequence[Colour] = ROLE_PALETTE,
    motor_colours: Any = None,
    thruster_colours: Any = None,
) -> DisplayList:
    """Display list of one scene (no leading axis).

    Args:
      roles: [n] index into `palette`; None paints all shapes as role 0.
      motor_colours, thruster_colours: [J] and [T] indices into MOTOR_PALETTE and THRUSTER_PALETTE, which controls
        drive what; None paints all motors alike, and nozzles in ink.
    """
    scene = _as_numpy(scene)
    colours = shape_colours(scene, roles, palette)
    parts = itertools.chain(
        _shapes(scene, colours),
        _thrusters(scene, thruster_colours),
        _springs(scene),
        _joints(scene, motor_colours),
    )
    return DisplayList(num_shapes=len(colours), primitives=tuple(parts))


def _as_numpy(scene: Scene) -> Scene:
    """Scene with all arrays on the host: they are read one number at a time."""
    parts = {name: getattr(scene, name) for name in ("shapes", "joints", "springs", "thrusters")}
    on_host = {
        name: type(part)(**{field: np.asarray(values) for field, values in vars(part).items()})
        for name, part in parts.items()
    }
    return dataclasses.replace(scene, **on_host)


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
    shade_without_mass = np.where(np.asarray(scene.shapes.kinematic), KINEMATIC_SHADE, FIXED_SHADE)
    shade = np.where(has_no_mass, shade_without_mass, 1.0)[:, None]
    return (np.asarray(palette, float)[roles] * shade).astype(np.uint8)


def rotate(vector: np.ndarray, angle: Any) -> np.ndarray:
    """Turns `[..., 2]` vectors counter-clockwise by angles (rad) that broadcast against `[...]`."""
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1)


def world_points(
    primitive: Primitive, position: np.ndarray, angle: np.ndarray, thrust: Any = None
) -> np.ndarray | None:
    """[k, 2] m: the points of a primitive in one picture; of rail and spring those of a line through all of them.

    position [n, 2] m, angle [n] rad, thrust [T] 0..1. None: a flame that is not there.
    """
    body, points = primitive.body, primitive.points
    if primitive.kind == RAIL:
        return _rail(primitive, position, angle)
    if primitive.kind == SPRING:
        return _coils(primitive, position, angle)
    if primitive.upright is not None:
        return position[body] + rotate(primitive.upright, angle[body]) + points
    if primitive.thruster is not None:
        fire = 0.0 if thrust is None else float(np.asarray(thrust)[primitive.thruster])
        if fire <= 0:
            return None
        base = np.asarray(primitive.scale_from)
        points = base + (points - base) * (primitive.size * fire)
    return position[body] + rotate(points, angle[body])


def _shapes(scene: Scene, colours: np.ndarray) -> Iterator[Primitive]:
    shapes = scene.shapes
    vertices, num_vertices = np.asarray(shapes.vertices, float), np.asarray(shapes.num_vertices)
    surface_speed, inverse_mass = np.asarray(shapes.surface_speed), np.asarray(shapes.inverse_mass)
    num_polygons = len(vertices)
    fills, outlines = colours.tolist(), (colours.astype(float) * OUTLINE_SHADE).tolist()
    # Fixed shapes first: what moves stays visible where a wall and a body overlap.
    for i in sorted(np.flatnonzero(np.asarray(shapes.active)).tolist(), key=lambda i: inverse_mass[i] > 0):
        facts: dict[str, Any] = {"part": (SHAPE, i), "body": i}
        fill, outline = fills[i], outlines[i]
        if i < num_polygons:
            corners = vertices[i, : num_vertices[i]]
            yield Primitive(kind=POLYGON, points=corners, fill=fill, outline=outline, **facts)
        else:
            radius = float(shapes.radius[i - num_polygons])
            yield Primitive(kind=DISC, points=np.zeros((1, 2)), radius=radius, fill=fill, outline=outline, **facts)
            spoke = np.array([[0.0, 0.0], [radius * SPOKE_SHARE, 0.0]])  # how far it has rolled
            yield Primitive(kind=LINE, points=spoke, fill=outline, width=LINE_WIDTH, **facts)
        if i < len(surface_speed) and surface_speed[i] != 0:
            for arrow in belt_arrows(scene, i):
                yield Primitive(kind=POLYGON, points=arrow, fill=outline, **facts)


def belt_arrows(scene: Scene, i: int) -> list[np.ndarray]:
    """Arrows [3, 2] m in the frame of shape i along its outline, to where its surface goes."""
    shapes = scene.shapes
    num_polygons = np.shape(shapes.vertices)[0]
    if i < num_polygons:
        corners = np.asarray(shapes.vertices, float)[i, : int(shapes.num_vertices[i])]
    else:
        turns = np.linspace(0, 2 * np.pi, BELT_CORNERS, endpoint=False)
        corners = rotate(np.array([float(shapes.radius[i - num_polygons]), 0.0]), turns)
    arrows = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = np.linalg.norm(end - start)
        # Clockwise, against the order of corners.
        along = (end - start) / length * -np.sign(float(shapes.surface_speed[i]))
        inward = np.array([start[1] - end[1], end[0] - start[0]]) / length
        count = max(1, int(length / BELT_SPACING_M))
        for share in (np.arange(count) + 0.5) / count:
            at = start + (end - start) * share + inward * 0.6 * BELT_ARROW_M
            side = 0.5 * BELT_ARROW_M * rotate(along, np.pi / 2)
            arrows.append(np.stack([at + along * BELT_ARROW_M, at + side, at - side]))
    return arrows


def _thrusters(scene: Scene, colours: Any) -> Iterator[Primitive]:
    """Nozzle, and the flame behind it with its core: the push is from the base of the nozzle to its tip."""
    thrusters, half = scene.thrusters, NOZZLE_SHARE * THRUSTER_LENGTH_M
    nozzle = np.array([[0.0, -half], [THRUSTER_LENGTH_M, 0.0], [0.0, half]])
    flame = np.array([[0.0, half], [-FLAME_SHARE * THRUSTER_LENGTH_M, 0.0], [0.0, -half]])
    for k in np.flatnonzero(np.asarray(thrusters.active)).tolist():
        at, angle = np.asarray(thrusters.position[k], float), float(thrusters.angle[k])
        facts: dict[str, Any] = {"kind": POLYGON, "part": (THRUSTER, k), "body": int(thrusters.body[k])}
        behind = {"points": at + rotate(flame, angle), "thruster": k, "scale_from": at}
        yield Primitive(fill=THRUSTER_PALETTE[0], **behind, **facts)
        yield Primitive(fill=FLAME_CORE, size=CORE_SHARE, **behind, **facts)
        fill = INK if colours is None else THRUSTER_PALETTE[int(colours[k])]
        yield Primitive(points=at + rotate(nozzle, angle), fill=fill, **facts)


def _springs(scene: Scene) -> Iterator[Primitive]:
    springs = scene.springs
    for k in np.flatnonzero(np.asarray(springs.active)).tolist():
        a, b = int(springs.a[k]), int(springs.b[k])
        anchor_a, anchor_b = np.asarray(springs.anchor_a[k], float), np.asarray(springs.anchor_b[k], float)
        facts: dict[str, Any] = {"part": (SPRING_PART, k), "fill": INK}
        yield Primitive(
            kind=SPRING,
            body=a,
            points=anchor_a[None],
            other=b,
            other_point=anchor_b,
            coils=NUM_COILS if springs.stiffness[k] != 0 else 0,
            reach=COIL_M,
            width=LINE_WIDTH,
            **facts,
        )
        for body, end in ((a, anchor_a), (b, anchor_b)):
            radius = SPRING_END_SHARE * JOINT_RADIUS_M
            yield Primitive(kind=DISC, body=body, points=end[None], radius=radius, **facts)


def _coils(spring: Primitive, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[p, 2] m: a zigzag where the spring has coils, else a straight line."""
    start = position[spring.body] + rotate(spring.points[0], angle[spring.body])
    end = position[spring.other] + rotate(np.asarray(spring.other_point), angle[spring.other])
    along = end - start
    length = float(np.linalg.norm(along))
    if spring.coils == 0 or length == 0:
        return np.stack([start, end])
    share = np.concatenate([[0], np.linspace(0.1, 0.9, 2 * spring.coils + 1), [1]])
    side = np.concatenate([[0, 0], np.tile([spring.reach, -spring.reach], spring.coils)[1:], [0, 0]])
    across = np.array([-along[1], along[0]]) / length
    return start + share[:, None] * along + side[:, None] * across


def _joints(scene: Scene, colours: Any) -> Iterator[Primitive]:
    joints = scene.joints
    for k in np.flatnonzero(np.asarray(joints.active)).tolist():
        kind, has_motor = int(joints.kind[k]), bool(joints.motor_on[k])
        motor = MOTOR_PALETTE[0 if colours is None else int(colours[k])]
        anchor = np.asarray(joints.anchor_a[k], float)
        facts: dict[str, Any] = {"part": (JOINT, k), "body": int(joints.a[k])}
        at = anchor[None]
        if kind == JointKind.PRISMATIC:  # a slider: a rail on a, and a block on it
            yield _rail_of(scene, k, facts)
            radius = JOINT_RADIUS_M * SLIDER_SHARE
            yield Primitive(kind=DISC, points=at, radius=radius, fill=motor if has_motor else INK, **facts)
        elif kind == JointKind.FIXED:  # a weld: a small cross
            for turn in WELD_ANGLES:
                arm = rotate(np.array([JOINT_RADIUS_M, 0.0]), turn)
                ends = np.stack([-arm, arm])
                yield Primitive(kind=LINE, points=ends, upright=anchor, fill=INK, width=WELD_WIDTH, **facts)
        else:  # a hinge: a disc, coloured at the middle when a motor drives it
            yield Primitive(kind=DISC, points=at, radius=JOINT_RADIUS_M, fill=HINGE, outline=INK, **facts)
            if has_motor:
                yield Primitive(kind=DISC, points=at, radius=JOINT_RADIUS_M * MOTOR_SHARE, fill=motor, **facts)


def _rail_of(scene: Scene, k: int, facts: dict[str, Any]) -> Primitive:
    """The rail of slider k: between its limits, or RAIL_M to each side of where b is."""
    joints = scene.joints
    anchor, axis_angle = np.asarray(joints.anchor_a[k], float), float(joints.axis_angle[k])
    if joints.has_limits[k]:
        limits = np.array([joints.lower_limit[k], joints.upper_limit[k]], float)
        ends = anchor + limits[:, None] * rotate(np.array([1.0, 0.0]), axis_angle)
        return Primitive(kind=LINE, points=ends, fill=INK, width=LINE_WIDTH, **facts)
    return Primitive(
        kind=RAIL,
        points=anchor[None],
        other=int(joints.b[k]),
        other_point=np.asarray(joints.anchor_b[k], float),
        angle=axis_angle,
        reach=RAIL_M,
        fill=INK,
        width=LINE_WIDTH,
        **facts,
    )


def _rail(rail: Primitive, position: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """[2, 2] m: `reach` to each side of the point of the other body, along the rail."""
    start = position[rail.body] + rotate(rail.points[0], angle[rail.body])
    axis = rotate(np.array([1.0, 0.0]), angle[rail.body] + rail.angle)
    at = position[rail.other] + rotate(np.asarray(rail.other_point), angle[rail.other])
    along = float((at - start) @ axis) + np.array([-rail.reach, rail.reach])
    return start + along[:, None] * axis
