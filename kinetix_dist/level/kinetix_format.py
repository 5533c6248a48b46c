"""The JSON files of the public Kinetix package, in and out.

Differences of the public format, and their treatment:
- polygons list their corners clockwise about a point that need not be the centroid: they are reversed and moved onto
  the true centroid, and positions, joint anchors and thrusters move along, so that the world looks the same;
- masses and inertias in a file are not those of its shapes (discs have half their inertia): they are computed again
  from geometry and density; shapes of zero inverse mass stay fixed;
- `friction` is a raw coefficient, multiplied by the engine's base friction; joint `rotation` is angle_b - angle_a at
  rest; a motor drives b relative to a towards +speed. All as in `Scene`;
- walls of two kinds of files are not where they are here: see `kinetix_walls.py`.

Shape i of the file is shape i of the level.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jax2d.builder_checks import reduced
from jax2d.scene import Capacity, JointKind
from kinetix_dist.level.angles import reduced_rest_angle
from kinetix_dist.level.derive import complete
from kinetix_dist.level.fit import capacity_of
from kinetix_dist.level.kinetix_checks import check_kinetix, param_notes, public_params, public_static_params
from kinetix_dist.level.kinetix_walls import USUAL_WALLS, PublicWalls, mended_wall, wall_of_file
from kinetix_dist.level.level import NUM_WALLS, Level
from kinetix_dist.level.validate import LevelFormatError, check_polygon, read_document
from kinetix_dist.level.walls import empty_level, pad_vertices

# What the 74 public files say; readers of these files expect the keys.
_EMPTY_MANIFOLD = {
    "normal": {"0": 0.0, "1": 0.0},
    "penetration": 0.0,
    "collision_point": {"0": 0.0, "1": 0.0},
    "active": False,
    "acc_impulse_normal": 0.0,
    "acc_impulse_tangent": 0.0,
    "restitution_velocity_target": 0.0,
}
_PARTS = ("polygon", "circle", "joint", "thruster")


def is_kinetix_document(document: Any) -> bool:
    """True of the JSON document of a level file of the public package."""
    return isinstance(document, dict) and "env_state" in document


@dataclasses.dataclass(frozen=True, kw_only=True)
class PublicLevel:
    """A public document as it is read."""

    level: Level  # numpy, with the capacity of the document's own arrays
    walls: PublicWalls  # as the document has them; those of the level are the usual box
    notes: tuple[str, ...]  # mended walls and ignored settings, a phrase each


def load_kinetix(path: str | Path) -> Level:
    """Reads a public level file; raises `LevelFormatError` naming the file and the field."""
    path = Path(path)
    document = read_document(path)
    try:
        return import_kinetix(document)
    except LevelFormatError as error:
        raise error.in_file(path) from None


def import_kinetix(document: Any) -> Level:
    """The level (numpy) of a public document, with the capacity of the document's own arrays."""
    return read_kinetix(document).level


def read_kinetix(document: Any) -> PublicLevel:
    """The level and its mended walls. Raises `LevelFormatError`."""
    if not is_kinetix_document(document):
        raise LevelFormatError("env_state", "is missing", "this is no level file of the public Kinetix package")
    walls = check_kinetix(document)
    notes = (*walls.notes, *param_notes(document))
    return PublicLevel(level=_read_state(document["env_state"], walls), walls=walls, notes=notes)


def _read_state(state: dict[str, Any], walls: PublicWalls) -> Level:
    polygons, circles, joints, thrusters = (state[part] for part in _PARTS)
    polygons = [mended_wall(wall, slot, walls) for slot, wall in enumerate(polygons[:NUM_WALLS])] + polygons[NUM_WALLS:]
    max_corners = max((shape["n_vertices"] for shape in polygons if shape["active"]), default=4)
    capacity = Capacity(
        polygons=len(polygons),
        circles=len(circles),
        joints=len(joints),
        thrusters=len(thrusters),
        vertices=max(4, max_corners),
    )
    level = empty_level(capacity)
    scene = level.scene
    scene.shapes.active[:] = [shape["active"] for shape in polygons + circles]
    is_fixed = ~scene.shapes.active
    shifts = np.zeros(capacity.shapes)  # rad, of angles that are reduced
    for slot, shape in enumerate(polygons + circles):
        if not shape["active"]:
            continue
        level.position[slot] = _pair(shape["position"])
        level.angle[slot] = reduced(shape["rotation"])
        shifts[slot] = reduced(shape["rotation"]) - shape["rotation"]
        level.velocity[slot] = _pair(shape["velocity"])
        level.angular_velocity[slot] = shape["angular_velocity"]
        level.shape_role[slot] = shape["role"]
        level.collision_mode[slot] = shape["collision_mode"]
        scene.shapes.density[slot] = shape["density"]
        scene.shapes.friction[slot] = shape["friction"]
        scene.shapes.restitution[slot] = shape["restitution"]
        is_fixed[slot] = shape["inverse_mass"] == 0.0
        if slot < capacity.polygons:
            corners = _corners(shape)
            check_polygon(corners.tolist(), f"env_state.polygon[{slot}].vertices", capacity)
            scene.shapes.vertices[slot] = pad_vertices(corners, capacity)
            scene.shapes.num_vertices[slot] = len(corners)
        else:
            scene.shapes.radius[slot - capacity.polygons] = shape["radius"]
    for slot, joint in enumerate(joints):
        if not joint["active"]:
            continue
        scene.joints.active[slot] = True
        scene.joints.a[slot], scene.joints.b[slot] = joint["a_index"], joint["b_index"]
        scene.joints.anchor_a[slot] = _pair(joint["a_relative_pos"])
        scene.joints.anchor_b[slot] = _pair(joint["b_relative_pos"])
        scene.joints.kind[slot] = JointKind.FIXED if joint["is_fixed_joint"] else JointKind.REVOLUTE
        scene.joints.rest_angle[slot] = reduced_rest_angle(
            joint["rotation"],
            shifts[joint["b_index"]] - shifts[joint["a_index"]],
            counts_turns=joint["motor_has_joint_limits"],
        )
        scene.joints.motor_on[slot] = joint["motor_on"]
        scene.joints.motor_speed[slot] = joint["motor_speed"]
        scene.joints.motor_power[slot] = joint["motor_power"]
        scene.joints.has_limits[slot] = joint["motor_has_joint_limits"]
        scene.joints.lower_limit[slot], scene.joints.upper_limit[slot] = joint["min_rotation"], joint["max_rotation"]
        level.motor_colour[slot] = joint["motor_binding"]
        level.motor_auto[slot] = joint.get("motor_auto", False)
    for slot, thruster in enumerate(thrusters):
        if not thruster["active"]:
            continue
        scene.thrusters.active[slot] = True
        scene.thrusters.body[slot] = thruster["object_index"]
        scene.thrusters.position[slot] = _pair(thruster["relative_position"])
        scene.thrusters.angle[slot] = reduced(thruster["rotation"])
        scene.thrusters.power[slot] = thruster["power"]
        level.thruster_colour[slot] = thruster["thruster_binding"]
    scene.gravity[:] = _pair(state["gravity"])
    return complete(level, is_fixed)


def export_kinetix(level: Level, walls: PublicWalls = USUAL_WALLS) -> dict[str, Any]:
    """A public document of one level. Impulse caches are empty; masses are ours (see the module docstring).

    walls: those of the file that the level was imported from, which the document gets again.
    Raises `LevelFormatError` for a level with a slider, which the public format does not have.
    """
    level = jax.tree.map(np.asarray, level)
    scene, capacity = level.scene, capacity_of(level)
    sliders = np.flatnonzero(scene.joints.active & scene.joints.is_kind(JointKind.PRISMATIC))
    if len(sliders):
        raise LevelFormatError(f"joints[{sliders[0]}]", "is prismatic, which public files cannot hold", "remove it")
    polygons, circles = capacity.polygons, capacity.circles
    state = {
        "polygon": [_shape_document(level, slot, capacity) for slot in range(polygons)],
        "circle": [_shape_document(level, slot, capacity) for slot in range(polygons, polygons + circles)],
        "joint": [_joint_document(level, slot) for slot in range(capacity.joints)],
        "thruster": [_thruster_document(level, slot) for slot in range(capacity.thrusters)],
        "collision_matrix": _indexed([_indexed([bool(x) for x in row]) for row in _joint_matrix(level)]),
        "acc_rr_manifolds": [_EMPTY_MANIFOLD] * (2 * (_pairs(polygons) - _pairs(NUM_WALLS))),
        "acc_cr_manifolds": [_EMPTY_MANIFOLD] * (polygons * circles),
        "acc_cc_manifolds": [_EMPTY_MANIFOLD] * _pairs(circles),
        "gravity": _point(scene.gravity),
    }
    state["polygon"][:NUM_WALLS] = [
        wall_of_file(wall, slot, walls) for slot, wall in enumerate(state["polygon"][:NUM_WALLS])
    ]
    static = public_static_params(polygons, circles, capacity.joints, capacity.thrusters)
    return {"env_state": state, "env_params": public_params(), "static_env_params": static}


def _pairs(count: int) -> int:
    return count * (count - 1) // 2


def _pair(value: dict[str, float]) -> tuple[float, float]:
    return value["0"], value["1"]


def _corners(shape: dict[str, Any]) -> np.ndarray:
    """`[k, 2]` corners, counter-clockwise; the first corner stays first."""
    corners = np.array([_pair(shape["vertices"][str(i)]) for i in range(shape["n_vertices"])], np.float64)
    following = np.roll(corners, -1, axis=0)
    area = 0.5 * np.sum(corners[:, 0] * following[:, 1] - corners[:, 1] * following[:, 0])
    return corners if area >= 0.0 else np.roll(corners[::-1], 1, axis=0)


def _joint_matrix(level: Level) -> np.ndarray:
    """`[n, n]` bool, False within a body: the collision matrix of public files (modes are not in it)."""
    scene = level.scene
    body = np.arange(len(scene.shapes.active))
    for slot in np.flatnonzero(scene.joints.active):
        body[body == body[scene.joints.b[slot]]] = body[scene.joints.a[slot]]
    return body[:, None] != body[None, :]


def _indexed(values: list[Any]) -> dict[str, Any]:
    return {str(i): value for i, value in enumerate(values)}


def _point(values: Any) -> dict[str, float]:
    return {"0": float(values[0]), "1": float(values[1])}


def _world(level: Level, slot: int, local: np.ndarray) -> np.ndarray:
    cos, sin = math.cos(level.angle[slot]), math.sin(level.angle[slot])
    return level.position[slot] + np.array([[cos, -sin], [sin, cos]]) @ local


def _shape_document(level: Level, slot: int, capacity: Capacity) -> dict[str, Any]:
    scene, is_polygon = level.scene, slot < capacity.polygons
    count = int(scene.shapes.num_vertices[slot]) if is_polygon else 0
    corners = np.zeros((capacity.vertices, 2))
    if is_polygon:
        corners[:count] = np.roll(
            scene.shapes.vertices[slot, :count][::-1], 1, axis=0
        )  # clockwise, the same corner first
        corners[count:] = corners[count - 1]
    return {
        "position": _point(level.position[slot]),
        "rotation": float(level.angle[slot]),
        "velocity": _point(level.velocity[slot]),
        "angular_velocity": float(level.angular_velocity[slot]),
        "inverse_mass": float(scene.shapes.inverse_mass[slot]),
        "inverse_inertia": float(scene.shapes.inverse_inertia[slot]),
        "friction": float(scene.shapes.friction[slot]),
        "restitution": float(scene.shapes.restitution[slot]),
        "collision_mode": int(level.collision_mode[slot]),
        "active": bool(scene.shapes.active[slot]),
        "n_vertices": count,
        "vertices": _indexed([_point(corner) for corner in corners]),
        "radius": 0.0 if is_polygon else float(scene.shapes.radius[slot - capacity.polygons]),
        "role": int(level.shape_role[slot]),
        "density": float(scene.shapes.density[slot]),
        "highlighted": False,
    }


def _joint_document(level: Level, slot: int) -> dict[str, Any]:
    scene = level.scene
    a = int(scene.joints.a[slot])
    # kinetix-env 3.0.2 refuses a file with this key, so that it is written only where it says something.
    always_runs = {"motor_auto": True} if level.motor_auto[slot] else {}
    return {
        "a_index": a,
        "b_index": int(scene.joints.b[slot]),
        "a_relative_pos": _point(scene.joints.anchor_a[slot]),
        "b_relative_pos": _point(scene.joints.anchor_b[slot]),
        "global_position": _point(_world(level, a, scene.joints.anchor_a[slot])),
        "active": bool(scene.joints.active[slot]),
        "acc_impulse": _point((0.0, 0.0)),
        "acc_r_impulse": 0.0,
        "motor_speed": float(scene.joints.motor_speed[slot]),
        "motor_power": float(scene.joints.motor_power[slot]),
        "motor_on": bool(scene.joints.motor_on[slot]),
        "motor_has_joint_limits": bool(scene.joints.has_limits[slot]),
        "min_rotation": float(scene.joints.lower_limit[slot]),
        "max_rotation": float(scene.joints.upper_limit[slot]),
        "is_fixed_joint": bool(scene.joints.is_kind(JointKind.FIXED)[slot]),
        "rotation": float(scene.joints.rest_angle[slot]),
        "motor_binding": int(level.motor_colour[slot]),
        **always_runs,
    }


def _thruster_document(level: Level, slot: int) -> dict[str, Any]:
    scene = level.scene
    body = int(scene.thrusters.body[slot])
    return {
        "object_index": body,
        "relative_position": _point(scene.thrusters.position[slot]),
        "rotation": float(scene.thrusters.angle[slot]),
        "power": float(scene.thrusters.power[slot]),
        "global_position": _point(_world(level, body, scene.thrusters.position[slot])),
        "active": bool(scene.thrusters.active[slot]),
        "thruster_binding": int(level.thruster_colour[slot]),
    }
