"""What is odd about the start of a valid level: nothing forbids it, and it is seldom meant.

overlap          two shapes that may touch lie in each other: physics pushes them apart
uncontrollable   no action moves anything
already_solved   green touches blue at the start; already_failed: green touches red
limits           a joint starts outside of its limits
outside          a shape has its centre outside of the box
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
from kinetix_dist.level.level import NUM_WALLS, WORLD_SIZE_M, Level
from kinetix_dist.level.roles import Role
from kinetix_dist.level.statistics import separations
from kinetix_dist.level.walls import FLOOR_TOP_M, WALL_NAMES

MIN_OVERLAP_M = 0.005  # less is half a pixel of a picture, and soon gone
LIMIT_TOLERANCE = 1e-4  # rad or m: rounding of float32 angles in files

_separations = jax.jit(separations)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StartWarning:
    """One thing that is odd, and the parts of the document that it is about."""

    kind: str
    paths: tuple[str, ...]  # "shapes[2]", "joints[0]", "walls.floor"; none: the level as a whole
    text: str  # one line


def start_warnings(level: Level, document: dict[str, Any]) -> list[StartWarning]:
    """Of one level (numpy) that `level_from_json` made of this document."""
    paths = shape_paths(level, document)
    found = itertools.chain(
        _overlaps(level, paths),
        _uncontrollable(level),
        _limits(level),
        _outside(level, paths),
    )
    return list(found)


def noop_warning(solved_at: int | None) -> list[StartWarning]:
    """solved_at: the step after which doing nothing has solved the level; None: it has not."""
    if solved_at is None:
        return []
    text = f"is solved by doing nothing, after {solved_at} steps; a level that solves itself teaches nothing"
    return [StartWarning(kind="noop", paths=(), text=text)]


def shape_paths(level: Level, document: dict[str, Any]) -> dict[int, str]:
    """Slot of each shape -> where the document speaks of it."""
    num_polygons = np.shape(level.scene.shapes.vertices)[0]
    paths = {slot: f"walls.{name}" for slot, name in enumerate(WALL_NAMES)}
    polygon, circle = itertools.count(NUM_WALLS), itertools.count(num_polygons)
    for i, shape in enumerate(document["shapes"]):
        paths[next(circle if shape["type"] == "circle" else polygon)] = f"shapes[{i}]"
    return paths


def _overlaps(level: Level, paths: dict[int, str]) -> Iterator[StartWarning]:
    """Pairs that may touch and do, and what that means for the roles."""
    shapes, roles = level.scene.shapes, np.asarray(level.shape_role)
    gaps = np.asarray(_separations(level))
    may_touch = np.triu(np.asarray(shapes.can_touch), 1)
    for a, b in np.argwhere(may_touch & (gaps < 0)).tolist():
        names = f"{paths[a]} and {paths[b]}"
        goal = {Role.BLUE: ("already_solved", "solved"), Role.RED: ("already_failed", "failed")}
        pair = {int(roles[a]), int(roles[b])}
        for other, (kind, outcome) in goal.items():
            if pair == {int(Role.GREEN), int(other)}:
                text = f"{names} touch at the start: the level is {outcome} in the first step"
                yield StartWarning(kind=kind, paths=(paths[a], paths[b]), text=text)
        if -gaps[a, b] > MIN_OVERLAP_M:
            text = f"{names} overlap by {-gaps[a, b]:.2g} m at the start: physics pushes them apart"
            yield StartWarning(kind="overlap", paths=(paths[a], paths[b]), text=text)


def _uncontrollable(level: Level) -> Iterator[StartWarning]:
    scene = level.scene
    moves = np.asarray(scene.shapes.inverse_mass) > 0
    joints, thrusters = scene.joints, scene.thrusters
    driven = np.asarray(joints.active) & np.asarray(joints.motor_on) & ~np.asarray(level.motor_auto)
    driven &= moves[np.asarray(joints.a)] | moves[np.asarray(joints.b)]
    pushed = np.asarray(thrusters.active) & moves[np.asarray(thrusters.body)]
    if not driven.any() and not pushed.any():
        text = "nothing can be controlled: there is no motor (but automatic ones) and no thruster that moves a shape"
        yield StartWarning(kind="uncontrollable", paths=(), text=text)


def _limits(level: Level) -> Iterator[StartWarning]:
    joints = level.scene.joints
    for k in np.flatnonzero(np.asarray(joints.active) & np.asarray(joints.has_limits)).tolist():
        at, unit = _joint_coordinate(level, k)
        low, high = float(joints.lower_limit[k]), float(joints.upper_limit[k])
        if not low - LIMIT_TOLERANCE <= at <= high + LIMIT_TOLERANCE:
            text = f"joints[{k}] starts at {at:.3g} {unit}, outside of its limits {low:.3g} to {high:.3g}"
            yield StartWarning(kind="limits", paths=(f"joints[{k}]",), text=text)


def _joint_coordinate(level: Level, k: int) -> tuple[float, str]:
    """What the limits of joint k bound, at the start, and its unit."""
    joints = level.scene.joints
    a, b = int(joints.a[k]), int(joints.b[k])
    angle_a, angle_b = float(level.angle[a]), float(level.angle[b])
    if int(joints.kind[k]) != JointKind.PRISMATIC:
        return angle_b - angle_a - float(joints.rest_angle[k]), "rad"
    start = np.asarray(level.position[a], float) + rotate(np.asarray(joints.anchor_a[k], float), angle_a)
    end = np.asarray(level.position[b], float) + rotate(np.asarray(joints.anchor_b[k], float), angle_b)
    axis = rotate(np.array([1.0, 0.0]), angle_a + float(joints.axis_angle[k]))
    return float((end - start) @ axis), "m"


def _outside(level: Level, paths: dict[int, str]) -> Iterator[StartWarning]:
    active = np.flatnonzero(np.asarray(level.scene.shapes.active))
    for i in active[active >= NUM_WALLS].tolist():
        x, y = (float(number) for number in level.position[i])
        if not (0 <= x <= WORLD_SIZE_M and FLOOR_TOP_M <= y <= WORLD_SIZE_M):
            box = f"0 to {WORLD_SIZE_M:g} m wide and {FLOOR_TOP_M:g} to {WORLD_SIZE_M:g} m high"
            text = f"{paths[i]} has its centre at ({x:.3g}, {y:.3g}) m, outside of the box, {box}"
            yield StartWarning(kind="outside", paths=(paths[i],), text=text)
