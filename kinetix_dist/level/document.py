"""`Level` -> document: the writing half of the level format (schema.py reads)."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import jax
import numpy as np

from jax2d.scene import JointKind
from kinetix_dist.json_text import json_text
from kinetix_dist.level.fit import capacity_of, smallest_size
from kinetix_dist.level.kinetix_walls import USUAL_WALLS, PublicWalls
from kinetix_dist.level.level import NUM_WALLS, ROLE_NAMES, Level
from kinetix_dist.level.walls import WALL_NAMES

FORMAT_NAME = "kinetix-dist-level"
FORMAT_VERSION = 1
JOINT_KINDS = {kind.name.lower(): kind for kind in JointKind}  # as files spell them
COLLISION_NAMES = ("ghost", "normal", "all")  # collision modes 0, 1, 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelInfo:
    """Name, size and description of a level in its document."""

    name: str
    size: str
    title: str = ""
    description: str = ""
    source: str = ""
    tags: tuple[str, ...] = ()
    difficulty: str = ""  # expected: "easy", "medium" or "hard"
    public_walls: PublicWalls = USUAL_WALLS  # those of the public file that it was imported from


def level_to_json(level: Level, info: LevelInfo | None = None) -> dict[str, Any]:
    """The document of one level; slots are compacted, shapes are named by kind and slot, walls by their names."""
    level = jax.tree.map(np.asarray, level)
    scene = level.scene
    names = _shape_names(level)
    info = info or LevelInfo(name="unnamed", size=smallest_size(level))
    document: dict[str, Any] = {
        "format": FORMAT_NAME,
        "version": FORMAT_VERSION,
        "name": info.name,
        "size": info.size,
        **({"title": info.title} if info.title else {}),
        **({"description": info.description} if info.description else {}),
        **({"source": info.source} if info.source else {}),
        **({"tags": list(info.tags)} if info.tags else {}),
        **({"difficulty": info.difficulty} if info.difficulty else {}),
        **({"public_walls": walls} if (walls := info.public_walls.to_json()) else {}),
        "gravity": _numbers(scene.gravity),
    }
    walls = {name: _surface(level, slot) for slot, name in enumerate(WALL_NAMES)}
    walls = {name: wall for name, wall in walls.items() if wall}
    if walls:
        document["walls"] = walls
    active = np.flatnonzero(scene.shapes.active).tolist()
    document["shapes"] = [_shape_document(level, slot, names[slot]) for slot in active if slot >= NUM_WALLS]
    document["joints"] = [_joint_document(level, slot, names) for slot in np.flatnonzero(scene.joints.active).tolist()]
    document["thrusters"] = [
        {
            "shape": names[scene.thrusters.body[slot]],
            "position": _numbers(scene.thrusters.position[slot]),
            "angle": _number(scene.thrusters.angle[slot]),
            "power": _number(scene.thrusters.power[slot]),
            "colour": int(level.thruster_colour[slot]),
        }
        for slot in np.flatnonzero(scene.thrusters.active)
    ]
    return document


def dump_document(document: dict[str, Any]) -> str:
    """JSON with one line per shape, joint and thruster: readable, and a change is a line of a diff."""
    lines = []
    for key, value in document.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            rows = ",\n".join("    " + json.dumps(row, allow_nan=False) for row in value)
            lines.append(f"  {json_text(key)}: [\n{rows}\n  ]")
        else:
            lines.append(f"  {json_text(key)}: {json.dumps(value, allow_nan=False)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"


def _number(value: Any) -> float:
    """A float32 as the shortest decimal that reads back as the same float32."""
    return float(str(np.float32(value)))


def _numbers(values: Any) -> list[float]:
    return [_number(value) for value in values]


def _shape_names(level: Level) -> dict[int, str]:
    polygons = capacity_of(level).polygons
    names = dict(enumerate(WALL_NAMES))
    for slot in np.flatnonzero(level.scene.shapes.active):
        if slot >= NUM_WALLS:
            names[int(slot)] = f"polygon_{slot}" if slot < polygons else f"circle_{slot - polygons}"
    return names


def _surface(level: Level, slot: int) -> dict[str, Any]:
    """Role, friction and restitution where they are not the default."""
    role, friction, restitution = (
        level.shape_role[slot],
        level.scene.shapes.friction[slot],
        level.scene.shapes.restitution[slot],
    )
    return {
        **({"role": ROLE_NAMES[role]} if role else {}),
        **({"friction": _number(friction)} if friction != 1.0 else {}),
        **({"restitution": _number(restitution)} if restitution != 0.0 else {}),
    }


def _shape_document(level: Level, slot: int, name: str) -> dict[str, Any]:
    scene = level.scene
    polygons = capacity_of(level).polygons
    if slot < polygons:
        corners = scene.shapes.vertices[slot, : scene.shapes.num_vertices[slot]]
        form = {"type": "polygon", "vertices": [_numbers(corner) for corner in corners]}
    else:
        form = {"type": "circle", "radius": _number(scene.shapes.radius[slot - polygons])}
    mode, density = int(level.collision_mode[slot]), scene.shapes.density[slot]
    moving = {
        **({"velocity": _numbers(level.velocity[slot])} if np.any(level.velocity[slot]) else {}),
        **({"angular_velocity": _number(level.angular_velocity[slot])} if level.angular_velocity[slot] else {}),
    }
    return {
        "id": name,
        **form,
        "position": _numbers(level.position[slot]),
        "angle": _number(level.angle[slot]),
        **moving,
        **_surface(level, slot),
        **({"density": _number(density)} if density != 1.0 else {}),
        **({"fixed": True} if scene.shapes.inverse_mass[slot] == 0.0 else {}),
        **({"collision": COLLISION_NAMES[mode]} if mode != 1 else {}),
    }


def _joint_document(level: Level, slot: int, names: dict[int, str]) -> dict[str, Any]:
    scene = level.scene
    motor = {
        "on": bool(scene.joints.motor_on[slot]),
        "speed": _number(scene.joints.motor_speed[slot]),
        "power": _number(scene.joints.motor_power[slot]),
        "colour": int(level.motor_colour[slot]),
        **({"auto": True} if level.motor_auto[slot] else {}),
    }
    kind = JointKind(int(scene.joints.kind[slot]))
    limits = _numbers((scene.joints.lower_limit[slot], scene.joints.upper_limit[slot]))
    return {
        "type": kind.name.lower(),
        "a": names[scene.joints.a[slot]],
        "b": names[scene.joints.b[slot]],
        "anchor_a": _numbers(scene.joints.anchor_a[slot]),
        "anchor_b": _numbers(scene.joints.anchor_b[slot]),
        "rest_angle": _number(scene.joints.rest_angle[slot]),
        **({"axis": _number(scene.joints.axis_angle[slot])} if kind == JointKind.PRISMATIC else {}),
        **({"limits": limits} if scene.joints.has_limits[slot] and kind != JointKind.FIXED else {}),
        "motor": motor,
    }
