"""Warnings about a valid level: nothing forbids it, and it is seldom meant. One list for editor and `levels validate`.

overlap          two shapes that may touch lie in each other: physics pushes them apart
uncontrollable   no action moves anything
already_solved   green touches blue at the start; already_failed: green touches red
limits           a joint starts outside of its limits
outside          a moving shape has its centre outside of the box, or a fixed one all of itself
idle             a motor or thruster that does nothing, or can only brake
anchor           a joint is far from both shapes that it holds, or its two ends are far apart
twice            two joints hold the same shapes at the same place
noop             solved by doing nothing (the caller plays it: `noop_warning`)
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from jax2d.display_list import rotate
from jax2d.scene import JointKind
from kinetix_dist.level.kinetix_format import is_kinetix_document
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Level, Role, driving_motors, pushing_thrusters
from kinetix_dist.level.statistics import point_distances, separations
from kinetix_dist.level.walls import FLOOR_TOP_M, WALL_NAMES

MIN_OVERLAP_M = 0.0125  # the public package lets resting shapes overlap by 1 cm, and its levels are saved so
LIMIT_TOLERANCE = 1e-4  # rad or m: rounding of float32 angles in files
FAR_ANCHOR_M = 0.25  # from the nearer of the two shapes; wheels on axles that are not drawn are nearer, and meant
MAX_QUIET_GAP_M = 0.02  # between the ends of a joint; more is seen as a jerk in the first steps
SAME_PLACE_M = 1e-3

_separations = jax.jit(separations)
_point_distances = jax.jit(point_distances)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StartWarning:
    """An oddity, and the parts of the document that it is about."""

    kind: str
    paths: tuple[str, ...]  # "shapes[2]", "joints[0]", "walls.floor"; none: the level as a whole
    text: str  # one line


@dataclasses.dataclass(frozen=True, kw_only=True)
class Paths:
    """Paths in a document of the shapes, joints and thrusters of a level."""

    shapes: dict[int, str]  # by slot
    joint: str  # "joints", or "env_state.joint" of a public file
    thruster: str


def start_warnings(level: Level, document: dict[str, Any]) -> list[StartWarning]:
    """Warnings about one level (numpy) that was read from this document, of either format. Nothing is simulated."""
    paths = paths_in(level, document)
    found = itertools.chain(
        _overlaps(level, paths),
        _uncontrollable(level),
        _limits(level, paths),
        _outside(level, paths),
        _idle_motors(level, paths),
        _idle_thrusters(level, paths),
        _far_anchors(level, paths),
        _twice(level, paths),
    )
    return list(found)


def noop_warning(solved_at: int | None) -> list[StartWarning]:
    """solved_at: the step after which doing nothing has solved the level; None: it has not."""
    if solved_at is None:
        return []
    text = f"is solved by doing nothing, after {solved_at} steps; a level that solves itself teaches nothing"
    return [StartWarning(kind="noop", paths=(), text=text)]


def paths_in(level: Level, document: dict[str, Any]) -> Paths:
    num_polygons = np.shape(level.scene.shapes.vertices)[0]
    if is_kinetix_document(document):
        count = len(np.asarray(level.scene.shapes.active))
        kinds = [("polygon", slot) for slot in range(num_polygons)]
        kinds += [("circle", slot) for slot in range(count - num_polygons)]
        shapes = {slot: f"env_state.{kind}[{i}]" for slot, (kind, i) in enumerate(kinds)}
        return Paths(shapes=shapes, joint="env_state.joint", thruster="env_state.thruster")
    shapes = {slot: f"walls.{name}" for slot, name in enumerate(WALL_NAMES)}
    polygon, circle = itertools.count(NUM_WALLS), itertools.count(num_polygons)
    for i, shape in enumerate(document["shapes"]):
        shapes[next(circle if shape["type"] == "circle" else polygon)] = f"shapes[{i}]"
    return Paths(shapes=shapes, joint="joints", thruster="thrusters")


def _overlaps(level: Level, paths: Paths) -> Iterator[StartWarning]:
    """Overlaps of shapes that may touch, and the outcome that they decide."""
    shapes, roles = level.scene.shapes, np.asarray(level.shape_role)
    gaps = np.asarray(_separations(level))
    may_touch = np.triu(np.asarray(shapes.can_touch), 1)
    for a, b in np.argwhere(may_touch & (gaps < 0)).tolist():
        names = f"{paths.shapes[a]} and {paths.shapes[b]}"
        goal = {Role.BLUE: ("already_solved", "solved"), Role.RED: ("already_failed", "failed")}
        pair = {int(roles[a]), int(roles[b])}
        for other, (kind, outcome) in goal.items():
            if pair == {int(Role.GREEN), int(other)}:
                text = f"{names} touch at the start: the level is {outcome} in the first step"
                yield StartWarning(kind=kind, paths=(paths.shapes[a], paths.shapes[b]), text=text)
        if -gaps[a, b] > MIN_OVERLAP_M:
            text = f"{names} overlap by {-gaps[a, b]:.2g} m at the start: physics pushes them apart"
            yield StartWarning(kind="overlap", paths=(paths.shapes[a], paths.shapes[b]), text=text)


def _uncontrollable(level: Level) -> Iterator[StartWarning]:
    if not driving_motors(level).any() and not pushing_thrusters(level).any():
        text = "nothing can be controlled: there is no motor with a speed (but automatic ones) and no thruster that "
        yield StartWarning(kind="uncontrollable", paths=(), text=f"{text}moves a shape")


def _limits(level: Level, paths: Paths) -> Iterator[StartWarning]:
    joints = level.scene.joints
    for k in np.flatnonzero(np.asarray(joints.active) & np.asarray(joints.has_limits)).tolist():
        at, unit = _joint_coordinate(level, k)
        low, high = float(joints.lower_limit[k]), float(joints.upper_limit[k])
        if not low - LIMIT_TOLERANCE <= at <= high + LIMIT_TOLERANCE:
            text = f"{paths.joint}[{k}] starts at {at:.3g} {unit}, outside of its limits {low:.3g} to {high:.3g}"
            yield StartWarning(kind="limits", paths=(f"{paths.joint}[{k}]",), text=text)


def _joint_coordinate(level: Level, k: int) -> tuple[float, str]:
    """Angle or offset that the limits of joint k bound, at the start, and its unit."""
    joints = level.scene.joints
    angle_a, angle_b = (float(level.angle[int(end[k])]) for end in (joints.a, joints.b))
    if int(joints.kind[k]) != JointKind.PRISMATIC:
        return angle_b - angle_a - float(joints.rest_angle[k]), "rad"
    start, end = _ends(level, k)
    axis = rotate(np.array([1.0, 0.0]), angle_a + float(joints.axis_angle[k]))
    return float((end - start) @ axis), "m"


def _ends(level: Level, k: int) -> tuple[np.ndarray, np.ndarray]:
    """[2] m each: where joint k holds a and where b, in the world at the start."""
    joints = level.scene.joints
    held = ((int(joints.a[k]), joints.anchor_a[k]), (int(joints.b[k]), joints.anchor_b[k]))
    at_a, at_b = (
        np.asarray(level.position[shape], float) + rotate(np.asarray(anchor, float), float(level.angle[shape]))
        for shape, anchor in held
    )
    return at_a, at_b


def _outside(level: Level, paths: Paths) -> Iterator[StartWarning]:
    active = np.flatnonzero(np.asarray(level.scene.shapes.active))
    for i in active[active >= NUM_WALLS].tolist():
        is_fixed = level.scene.shapes.inverse_mass[i] == 0
        low, high = _extent(level, i) if is_fixed else (level.position[i], level.position[i])
        (left, bottom), (right, top) = np.asarray(low, float).tolist(), np.asarray(high, float).tolist()
        if not (right >= 0 and left <= WORLD_SIZE_M and top >= FLOOR_TOP_M and bottom <= WORLD_SIZE_M):
            x, y = (float(number) for number in level.position[i])
            box = f"0 to {WORLD_SIZE_M:g} m wide and {FLOOR_TOP_M:g} to {WORLD_SIZE_M:g} m high"
            verb = "lies" if is_fixed else "has its centre"
            text = f"{paths.shapes[i]} {verb} at ({x:.3g}, {y:.3g}) m, outside of the box, {box}"
            yield StartWarning(kind="outside", paths=(paths.shapes[i],), text=text)


def _extent(level: Level, shape: int) -> tuple[np.ndarray, np.ndarray]:
    """[2] m each: the least and the largest coordinates of a shape."""
    shapes, centre = level.scene.shapes, np.asarray(level.position[shape], float)
    num_polygons = np.shape(shapes.vertices)[0]
    if shape >= num_polygons:
        radius = float(shapes.radius[shape - num_polygons])
        return centre - radius, centre + radius
    corners = np.array([rotate(np.asarray(c, float), float(level.angle[shape])) for c in shapes.vertices[shape]])
    return centre + corners.min(axis=0), centre + corners.max(axis=0)


def _idle_motors(level: Level, paths: Paths) -> Iterator[StartWarning]:
    joints = level.scene.joints
    moves = np.asarray(level.scene.shapes.inverse_mass) > 0
    has_motor = np.asarray(joints.motor_on) & ~np.asarray(joints.is_kind(JointKind.FIXED))
    for k in np.flatnonzero(np.asarray(joints.active)).tolist():
        path = f"{paths.joint}[{k}]"
        if not moves[int(joints.a[k])] and not moves[int(joints.b[k])]:
            text = f"{path} joins two fixed shapes: it does nothing{', nor does its motor' if has_motor[k] else ''}"
        elif has_motor[k] and joints.motor_speed[k] == 0:
            text = f"{path} has a motor of speed 0: actions can make it brake, and never move"
        elif has_motor[k] and joints.motor_power[k] == 0:
            text = f"{path} has a motor of power 0: it does nothing"
        else:
            continue
        yield StartWarning(kind="idle", paths=(path,), text=text)


def _idle_thrusters(level: Level, paths: Paths) -> Iterator[StartWarning]:
    thrusters = level.scene.thrusters
    idle = np.asarray(thrusters.active) & ~pushing_thrusters(level)
    for k in np.flatnonzero(idle).tolist():
        path, body = f"{paths.thruster}[{k}]", paths.shapes[int(thrusters.body[k])]
        why = "has power 0" if thrusters.power[k] == 0 else f"pushes {body}, which is fixed"
        yield StartWarning(kind="idle", paths=(path,), text=f"{path} {why}: it does nothing")


def _far_anchors(level: Level, paths: Paths) -> Iterator[StartWarning]:
    joints = level.scene.joints
    for k in np.flatnonzero(np.asarray(joints.active)).tolist():
        path, (at_a, at_b) = f"{paths.joint}[{k}]", _ends(level, k)
        slides = int(joints.kind[k]) == JointKind.PRISMATIC
        gap = float(np.hypot(*(at_b - at_a)))
        if gap > MAX_QUIET_GAP_M and not slides:
            text = f"{path} holds points {gap:.2g} m apart: it pulls them together in the first steps"
            yield StartWarning(kind="anchor", paths=(path,), text=text)
        held = (int(joints.a[k]), int(joints.b[k]))
        distances = [float(_point_distances(level, point)[shape]) for shape, point in zip(held, (at_a, at_b))]
        if min(distances) > FAR_ANCHOR_M:
            far = " and ".join(f"{d:.2g} m from {paths.shapes[shape]}" for d, shape in zip(distances, held))
            text = f"{path} is {far}: they turn about it as if on long rods"
            yield StartWarning(kind="anchor", paths=(path,), text=text)


def _twice(level: Level, paths: Paths) -> Iterator[StartWarning]:
    joints = level.scene.joints
    active = np.flatnonzero(np.asarray(joints.active)).tolist()
    for first, second in itertools.combinations(active, 2):
        pairs = [{int(joints.a[k]), int(joints.b[k])} for k in (first, second)]
        apart = np.hypot(*(np.mean(_ends(level, first), axis=0) - np.mean(_ends(level, second), axis=0)))
        if pairs[0] == pairs[1] and apart < SAME_PLACE_M:
            names = tuple(f"{paths.joint}[{k}]" for k in (first, second))
            text = f"{names[0]} and {names[1]} join the same shapes at the same place: one of them is enough"
            yield StartWarning(kind="twice", paths=names, text=text)
