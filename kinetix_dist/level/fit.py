"""Sizes: what a level uses, the smallest size it fits, and moving it into a larger capacity."""

from __future__ import annotations

import numpy as np

from jax2d import scene
from jax2d.fields import Field, make
from jax2d.scene import Capacity
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
    return scene.capacity_of(level.scene)


def usage(level: Level) -> dict[str, int]:
    """How many polygons (walls included), circles, joints and thrusters one level has."""
    shapes = level.scene.shapes
    num_polygons = shapes.num_vertices.shape[-1]
    active = np.asarray(shapes.active)
    return {
        "polygons": int(active[:num_polygons].sum()),
        "circles": int(active[num_polygons:].sum()),
        "joints": int(np.sum(level.scene.joints.active)),
        "thrusters": int(np.sum(level.scene.thrusters.active)),
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
    shapes = level.scene.shapes
    active = np.asarray(shapes.active)
    polygons = _slots(active[: have.polygons], capacity.polygons, "polygons")
    circles = _slots(active[have.polygons :], capacity.circles, "circles")
    joints = _slots(np.asarray(level.scene.joints.active), capacity.joints, "joints")
    thrusters = _slots(np.asarray(level.scene.thrusters.active), capacity.thrusters, "thrusters")
    max_vertices = int(np.max(np.asarray(shapes.num_vertices)[polygons], initial=0))
    if max_vertices > capacity.vertices:
        raise LevelSizeError(
            f"level has a polygon of {max_vertices} corners; the size has room for {capacity.vertices}"
        )
    source = {
        "P": polygons,
        "C": circles,
        "n": np.concatenate([polygons, have.polygons + circles]),
        "J": joints,
        "T": thrusters,
        "V": np.minimum(np.arange(capacity.vertices), have.vertices - 1),
    }
    target = {letter: np.arange(len(slots)) for letter, slots in source.items()}
    target["n"] = np.concatenate([target["P"], capacity.polygons + target["C"]])
    blank = empty_level(capacity)

    def placed(field: Field) -> np.ndarray:
        """The field with what the level has in its slots, and nothing in the others."""
        out, values = np.array(field.get(blank)), np.asarray(field.get(level))
        letters = [(axis, letter) for axis, letter in enumerate(field.dims) if letter in source]
        if not letters:
            return values
        if field.refers_to == "n":
            new_number = np.zeros(have.shapes, np.int32)  # of shapes left out: nothing active refers to them
            new_number[source["n"]] = target["n"]
            values = new_number[values]
        grid = np.ix_(*(source[letter] for _, letter in letters))
        out[np.ix_(*(target[letter] for _, letter in letters))] = values[grid]
        return out

    return make(Level, placed)


def _slots(active: np.ndarray, room: int, kind: str) -> np.ndarray:
    """Which old slots to carry over: all of them where there is room, else the active ones."""
    if len(active) <= room:
        return np.arange(len(active))
    used = np.flatnonzero(active)
    if len(used) > room:
        raise LevelSizeError(f"level has {len(used)} {kind}, walls included; the size has room for {room}")
    return used
