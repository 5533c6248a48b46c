"""Sizes: the slots that a level uses, the smallest size it fits, and moving it into arrays of another capacity."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jax2d import scene
from jax2d.fields import Field, make
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
    return scene.capacity_of(level.scene)


def usage(level: Level) -> dict[str, int]:
    """Number of polygons (walls included), circles, joints and thrusters of one level."""
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
    """One level (numpy) in arrays of another capacity; slot order stays, new slots are inactive.

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
    slots = {"P": polygons, "C": circles, "J": joints, "T": thrusters}
    return _in_slots(level, have, capacity, slots, np)


def pad_levels(levels: Level, capacity: Capacity) -> Level:
    """A batch of levels, [W, ...], in arrays of a capacity with at least as many slots; slot order stays, new slots
    are inactive. Works inside jit. Raises `LevelSizeError` where the capacity has fewer slots of a kind."""
    have = capacity_of(levels)
    if have == capacity:
        return levels
    for kind in ("polygons", "circles", "joints", "thrusters", "vertices"):
        if getattr(have, kind) > getattr(capacity, kind):
            raise LevelSizeError(
                f"levels have room for {getattr(have, kind)} {kind}, the larger capacity for {getattr(capacity, kind)}"
            )
    counts = {"P": have.polygons, "C": have.circles, "J": have.joints, "T": have.thrusters}
    return _in_slots(levels, have, capacity, {letter: np.arange(count) for letter, count in counts.items()}, jnp)


def size_numbers(levels: Level) -> Array:
    """[W] int32: of each level of a batch, the number in `SIZES` of the smallest size that it fits, as `smallest_size`.

    A level of arrays that no size has room for counts as the largest size. Works inside jit.
    """
    shapes = levels.scene.shapes
    num_polygons = shapes.num_vertices.shape[-1]
    used = {
        "polygons": shapes.active[..., :num_polygons],
        "circles": shapes.active[..., num_polygons:],
        "joints": levels.scene.joints.active,
        "thrusters": levels.scene.thrusters.active,
    }
    counts = {kind: jnp.sum(active, axis=-1) for kind, active in used.items()}
    fits = [
        jnp.all(jnp.stack([count <= getattr(capacity, kind) for kind, count in counts.items()]), axis=0)
        for capacity in list(SIZES.values())[:-1]
    ]
    return jnp.argmax(jnp.stack([*fits, jnp.ones_like(fits[0])]), axis=0).astype(jnp.int32)


def _in_slots(level: Level, have: Capacity, capacity: Capacity, slots: Mapping[str, np.ndarray], arrays: Any) -> Level:
    """A level (or a batch) of capacity `have` in arrays of `capacity`.

    slots: by letter of P, C, J and T, the old slots that come first there, in this order; nothing is in the others.
    arrays: the module that moves them, numpy or jax.numpy.
    """
    shapes = np.concatenate([slots["P"], have.polygons + slots["C"]])
    new_shapes = np.concatenate([np.arange(len(slots["P"])), capacity.polygons + np.arange(len(slots["C"]))])
    new_number = np.zeros(have.shapes, np.int32)  # of shapes left out: nothing active refers to them
    new_number[shapes] = new_shapes
    sizes = capacity.sizes
    taken_from = {letter: _padded(old, sizes[letter]) for letter, old in slots.items()}
    taken_from["V"] = np.minimum(np.arange(capacity.vertices), have.vertices - 1)
    taken_from["n"] = np.full(capacity.shapes, _NOTHING)
    taken_from["n"][new_shapes] = shapes
    blank = empty_level(capacity)

    def placed(field: Field) -> Any:
        """The field with the values of the level in its slots, and empty ones in the others."""
        values = field.get(level)
        letters = [(axis, letter) for axis, letter in enumerate(field.dims) if letter in taken_from]
        if not letters:
            return arrays.asarray(values)
        if field.refers_to == "n":
            values = arrays.asarray(new_number)[values]
        empty = field.get(blank)
        is_taken = np.ones(empty.shape, bool)
        num_leading = np.ndim(values) - len(field.dims)  # of a batch
        for axis, letter in letters:
            source = taken_from[letter]
            values = arrays.take(values, np.maximum(source, 0), axis=num_leading + axis)
            is_taken &= np.expand_dims(source != _NOTHING, tuple(i for i in range(empty.ndim) if i != axis))
        return arrays.where(is_taken, values, empty)

    return make(Level, placed)


_NOTHING = -1  # in place of a slot's number: the value in an empty level


def _padded(old_slots: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([old_slots, np.full(length - len(old_slots), _NOTHING, old_slots.dtype)])


def _slots(active: np.ndarray, room: int, kind: str) -> np.ndarray:
    """Old slots to carry over: all of them if they fit, else the active ones."""
    if len(active) <= room:
        return np.arange(len(active))
    used = np.flatnonzero(active)
    if len(used) > room:
        has = f"level has {len(used)} {kind}, walls included; the size has room for {room}"
        raise LevelSizeError(f"{has}: take a larger one (env.size)")
    return used
