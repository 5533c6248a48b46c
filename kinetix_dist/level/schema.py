"""The level format: readable JSON <-> `Level`. docs/level_format.md describes it, levels/schema.json is its structure.

    level, info = load_level("levels/s/hop_over.json")
    save_level(level, "mine.json", info)

A document gives shapes and positions; centres of mass, masses, inertias and contact permissions are computed
(`derive.py`). Positions in a document are the origin of a shape's own frame, which need not be its centroid: in the
`Level` it is.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

from jax2d.builder_checks import reduced
from jax2d.scene import Capacity
from kinetix_dist.atomic_files import replace_file
from kinetix_dist.level.angles import reduced_rest_angle
from kinetix_dist.level.canonical import in_order, turn_round, turned_colours
from kinetix_dist.level.derive import complete
from kinetix_dist.level.document import COLLISION_NAMES, JOINT_KINDS, LevelInfo, dump_document, level_to_json
from kinetix_dist.level.fit import capacity_of_size
from kinetix_dist.level.kinetix_walls import PublicWalls
from kinetix_dist.level.level import NUM_WALLS, ROLE_NAMES, Level
from kinetix_dist.level.validate import LevelFormatError, read_document, validate_document
from kinetix_dist.level.walls import WALL_NAMES, empty_level, pad_vertices

__all__ = [
    "LevelFormatError",
    "LevelInfo",
    "level_as_written",
    "level_from_json",
    "level_to_json",
    "load_level",
    "save_level",
    "turned_colours_of",
]


def load_level(path: str | Path, size: str | None = None) -> tuple[Level, LevelInfo]:
    """Reads a level file into arrays of its own size, or of `size`. Raises `LevelFormatError` naming file and field."""
    path = Path(path)
    document = read_document(path)
    try:
        level = level_from_json(document, size)
    except LevelFormatError as error:
        raise error.in_file(path) from None
    return level, document_info(document)


def save_level(level: Level, path: str | Path, info: LevelInfo) -> None:
    """Writes one level, whole or not at all; its document is validated first, so a file that exists can be loaded."""
    document = level_to_json(level, info)
    level_from_json(document)
    replace_file(Path(path), dump_document(document).encode())


def level_from_json(document: Any, size: str | Capacity | None = None) -> Level:
    """The level of a document, as numpy arrays of the document's own size, of a named size or of a capacity."""
    if isinstance(size, Capacity):
        capacity, size_name = size, None
    else:
        size_name = size or (document.get("size") if isinstance(document, dict) else None)
        if size_name is None or not isinstance(size_name, str):
            raise LevelFormatError("size", "is missing or no text", 'add "size": one of s, m, l')
        try:
            capacity = capacity_of_size(size_name)
        except ValueError as error:
            raise LevelFormatError("size", f"unknown size {size_name!r}", "use one of s, m, l") from error
    validate_document(document, capacity, size_name)
    return complete(*_assemble(document, capacity))


def turned_colours_of(document: Any) -> np.ndarray:
    """[4] bool: motor colours of a valid document whose actions forward and backward have changed places in its level,
    see `canonical.turned_colours`."""
    return np.asarray(_turned_colours(*_assemble(document, capacity_of_size(document["size"]))))


@jax.jit
def _turned_colours(level: Level, is_fixed: np.ndarray) -> jax.Array:
    ordered = level.scene.replace(joints=in_order(level.scene.joints))
    return turned_colours(dataclasses.replace(level, scene=ordered), is_fixed)


def level_as_written(document: Any) -> Level:
    """The level of a valid document with the signs of its motors as they are in it: that of actions which were recorded
    with them."""
    level = level_from_json(document)
    return jax.tree.map(np.asarray, turn_round(level, turned_colours_of(document)))


def document_info(document: dict[str, Any]) -> LevelInfo:
    """Name, size and description of a level, of its valid document."""
    names = [field.name for field in dataclasses.fields(LevelInfo)]
    given = {name: document[name] for name in names if name in document}
    given["tags"] = tuple(given.get("tags", ()))
    given["public_walls"] = PublicWalls.from_json(given.get("public_walls", {}))
    return LevelInfo(**given)


def _assemble(document: dict[str, Any], capacity: Capacity) -> tuple[Level, np.ndarray]:
    """Return the level of a document before masses are derived, and `is_fixed` [n]."""
    level = empty_level(capacity)
    shifts = np.zeros(capacity.shapes)  # rad, of angles that are reduced
    scene = level.scene
    is_fixed = np.asarray(scene.shapes.active).copy()  # the walls
    slots = {name: slot for slot, name in enumerate(WALL_NAMES)}
    for name, wall in document.get("walls", {}).items():
        _fill_surface(level, slots[name], wall)
    next_polygon, next_circle = NUM_WALLS, capacity.polygons
    for shape in document["shapes"]:
        if shape["type"] == "circle":
            slot, next_circle = next_circle, next_circle + 1
            scene.shapes.radius[slot - capacity.polygons] = shape["radius"]
        else:
            slot, next_polygon = next_polygon, next_polygon + 1
            corners = np.asarray(_corners(shape), np.float64)
            scene.shapes.vertices[slot] = pad_vertices(corners, capacity)
            scene.shapes.num_vertices[slot] = len(corners)
        slots[shape["id"]] = slot
        scene.shapes.active[slot] = True
        is_fixed[slot] = shape.get("fixed", False)
        scene.shapes.density[slot] = shape.get("density", 1.0)
        _fill_surface(level, slot, shape)
        level.position[slot] = shape["position"]
        angle = shape.get("angle", 0.0)
        level.angle[slot] = reduced(angle)
        shifts[slot] = reduced(angle) - angle
        level.velocity[slot] = shape.get("velocity", (0.0, 0.0))
        level.angular_velocity[slot] = shape.get("angular_velocity", 0.0)
        level.collision_mode[slot] = COLLISION_NAMES.index(shape.get("collision", "normal"))
    for slot, joint in enumerate(document.get("joints", [])):
        _fill_joint(level, slot, joint, slots, shifts)
    for slot, thruster in enumerate(document.get("thrusters", [])):
        body = slots[thruster["shape"]]
        scene.thrusters.active[slot] = True
        scene.thrusters.body[slot] = body
        if "anchor" in thruster:
            scene.thrusters.position[slot] = _to_local(level, body, thruster["anchor"])
        else:
            scene.thrusters.position[slot] = thruster.get("position", (0.0, 0.0))
        scene.thrusters.angle[slot] = reduced(thruster["angle"])
        scene.thrusters.power[slot] = thruster.get("power", 1.0)
        level.thruster_colour[slot] = thruster.get("colour", 0)
    scene.gravity[:] = document.get("gravity", (0.0, -9.81))
    return level, is_fixed


def _corners(shape: dict[str, Any]) -> list[list[float]]:
    if shape["type"] == "polygon":
        return shape["vertices"]
    x, y = 0.5 * shape["width"], 0.5 * shape["height"]
    return [[x, y], [-x, y], [-x, -y], [x, -y]]


def _fill_surface(level: Level, slot: int, entry: dict[str, Any]) -> None:
    level.scene.shapes.friction[slot] = entry.get("friction", 1.0)
    level.scene.shapes.restitution[slot] = entry.get("restitution", 0.0)
    level.shape_role[slot] = ROLE_NAMES.index(entry.get("role", "none"))


def _fill_joint(level: Level, slot: int, joint: dict[str, Any], slots: dict[str, int], shifts: np.ndarray) -> None:
    scene = level.scene
    a, b = slots[joint["a"]], slots[joint["b"]]
    scene.joints.active[slot] = True
    scene.joints.a[slot], scene.joints.b[slot] = a, b
    if "anchor" in joint:
        scene.joints.anchor_a[slot] = _to_local(level, a, joint["anchor"])
        scene.joints.anchor_b[slot] = _to_local(level, b, joint["anchor"])
    else:
        scene.joints.anchor_a[slot], scene.joints.anchor_b[slot] = joint["anchor_a"], joint["anchor_b"]
    scene.joints.kind[slot] = JOINT_KINDS[joint["type"]]
    scene.joints.rest_angle[slot] = (
        reduced_rest_angle(joint["rest_angle"], shifts[b] - shifts[a], counts_turns="limits" in joint)
        if "rest_angle" in joint
        else float(level.angle[b] - level.angle[a])
    )
    scene.joints.axis_angle[slot] = reduced(joint.get("axis", 0.0))
    if "limits" in joint:
        scene.joints.has_limits[slot] = True
        scene.joints.lower_limit[slot], scene.joints.upper_limit[slot] = joint["limits"]
    motor = joint.get("motor")
    if motor is not None:
        scene.joints.motor_on[slot] = motor.get("on", True)
        scene.joints.motor_speed[slot] = motor.get("speed", 1.0)
        scene.joints.motor_power[slot] = motor.get("power", 1.0)
        level.motor_auto[slot] = motor.get("auto", False)
        level.motor_colour[slot] = motor.get("colour", 0)


def _rotation(level: Level, slot: int) -> np.ndarray:
    cos, sin = math.cos(level.angle[slot]), math.sin(level.angle[slot])
    return np.array([[cos, -sin], [sin, cos]])


def _to_local(level: Level, slot: int, point: Any) -> np.ndarray:
    return _rotation(level, slot).T @ (np.asarray(point, np.float64) - level.position[slot])
