"""Sizes: what a level uses, the smallest size it fits, and moving it into a larger capacity."""

from __future__ import annotations

import dataclasses

import numpy as np

from jax2d.scene import Array, Capacity
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.walls import empty_level


class LevelSizeError(ValueError):
    """A level needs more room than the size it is to be put into."""


def capacity_of_size(size: str) -> Capacity:
    """The capacity of "s", "m" or "l"; raises `ValueError` naming the known sizes."""
    if size not in SIZES:
        raise ValueError(f"unknown size {size!r}; sizes are {', '.join(SIZES)}")
    return SIZES[size]


def capacity_of(level: Level) -> Capacity:
    """The capacity that the arrays of a level (or of a batch) have."""
    scene = level.scene
    return Capacity(
        polygons=scene.num_vertices.shape[-1],
        circles=scene.radius.shape[-1],
        joints=scene.joint_active.shape[-1],
        thrusters=scene.thruster_active.shape[-1],
        vertices=scene.vertices.shape[-2],
    )


def usage(level: Level) -> dict[str, int]:
    """How many polygons (walls included), circles, joints and thrusters one level has."""
    scene = level.scene
    num_polygons = scene.num_vertices.shape[-1]
    active = np.asarray(scene.shape_active)
    return {
        "polygons": int(active[:num_polygons].sum()),
        "circles": int(active[num_polygons:].sum()),
        "joints": int(np.sum(scene.joint_active)),
        "thrusters": int(np.sum(scene.thruster_active)),
    }


def smallest_size(level: Level) -> str:
    """The smallest size one level fits; raises `LevelSizeError` where none is large enough."""
    used = usage(level)
    for name, capacity in SIZES.items():
        if all(count <= getattr(capacity, kind) for kind, count in used.items()):
            return name
    largest = list(SIZES)[-1]
    over = [
        f"{count} {kind} (size {largest} has {getattr(SIZES[largest], kind)})"
        for kind, count in used.items()
        if count > getattr(SIZES[largest], kind)
    ]
    raise LevelSizeError(f"level has {', '.join(over)}; remove some")


def fit_level(level: Level, capacity: Capacity) -> Level:
    """One level (numpy) in arrays of another capacity; slot order is kept, new slots are inactive.

    Where the capacity has fewer slots than the arrays, active entries move up into the first slots. Raises
    `LevelSizeError` where they do not fit.
    """
    have = capacity_of(level)
    if have == capacity:
        return level
    scene, blank = level.scene, empty_level(capacity)
    active = np.asarray(scene.shape_active)
    polygons = _slots(active[: have.polygons], capacity.polygons, "polygons")
    circles = _slots(active[have.polygons :], capacity.circles, "circles")
    joints = _slots(np.asarray(scene.joint_active), capacity.joints, "joints")
    thrusters = _slots(np.asarray(scene.thruster_active), capacity.thrusters, "thrusters")
    most_vertices = int(np.max(np.asarray(scene.num_vertices)[polygons], initial=0))
    if most_vertices > capacity.vertices:
        raise LevelSizeError(
            f"level has a polygon of {most_vertices} corners; the size has room for {capacity.vertices}"
        )
    shapes = np.concatenate([polygons, have.polygons + circles])
    target = np.concatenate([np.arange(len(polygons)), capacity.polygons + np.arange(len(circles))])
    new_index = np.zeros(have.shapes, np.int32)  # old shape index -> new; inactive ones are not referred to
    new_index[shapes] = target

    def place(old: Array, new: Array, source: np.ndarray, into: np.ndarray) -> np.ndarray:
        out = np.array(new)
        out[into] = np.asarray(old)[source]
        return out

    sources = {
        "shape": (shapes, target),
        "polygon": (polygons, np.arange(len(polygons))),
        "circle": (circles, np.arange(len(circles))),
        "joint": (joints, np.arange(len(joints))),
        "thruster": (thrusters, np.arange(len(thrusters))),
    }

    def fields(old: object, new: object, kinds: dict[str, str]) -> dict[str, np.ndarray]:
        return {name: place(getattr(old, name), getattr(new, name), *sources[kind]) for name, kind in kinds.items()}

    kept = min(have.vertices, capacity.vertices)
    vertices = np.array(blank.scene.vertices)
    old_vertices = np.asarray(scene.vertices)[polygons]
    vertices[: len(polygons), :kept] = old_vertices[:, :kept]
    vertices[: len(polygons), kept:] = old_vertices[:, kept - 1 : kept]
    can_touch = np.zeros((capacity.shapes, capacity.shapes), bool)
    can_touch[np.ix_(target, target)] = np.asarray(scene.can_touch)[np.ix_(shapes, shapes)]
    scene_fields = fields(scene, blank.scene, _SCENE_KINDS)
    for end in ("joint_a", "joint_b", "thruster_body"):
        filled = sources["thruster" if end == "thruster_body" else "joint"][1]
        scene_fields[end][filled] = new_index[scene_fields[end][filled]]
    new_scene = dataclasses.replace(
        blank.scene, **scene_fields, vertices=vertices, can_touch=can_touch, gravity=np.asarray(scene.gravity)
    )
    return dataclasses.replace(blank, scene=new_scene, **fields(level, blank, _LEVEL_KINDS))


_SCENE_KINDS = {
    **dict.fromkeys(
        ("shape_active", "inverse_mass", "inverse_inertia", "density", "friction", "restitution"), "shape"
    ),
    "num_vertices": "polygon",
    "radius": "circle",
    **dict.fromkeys(
        (
            "joint_active", "joint_a", "joint_b", "joint_anchor_a", "joint_anchor_b", "joint_is_fixed",
            "joint_rest_angle", "motor_on", "motor_speed", "motor_power", "has_limits", "lower_limit", "upper_limit",
        ),
        "joint",
    ),
    **dict.fromkeys(
        ("thruster_active", "thruster_body", "thruster_position", "thruster_angle", "thruster_power"), "thruster"
    ),
}  # fmt: skip
_LEVEL_KINDS = {
    **dict.fromkeys(
        ("position", "angle", "velocity", "angular_velocity", "shape_role", "collision_mode"), "shape"
    ),
    **dict.fromkeys(("motor_colour", "motor_auto"), "joint"),
    "thruster_colour": "thruster",
}  # fmt: skip


def _slots(active: np.ndarray, room: int, kind: str) -> np.ndarray:
    """Which old slots to carry over: all of them where there is room, else the active ones."""
    if len(active) <= room:
        return np.arange(len(active))
    used = np.flatnonzero(active)
    if len(used) > room:
        raise LevelSizeError(f"level has {len(used)} {kind}, walls included; the size has room for {room}")
    return used
