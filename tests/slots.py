"""Slots of records, by the declaration of their fields: which are in use, and the same record in another order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from jax2d.fields import SLOTS, Array, Field, make
from jax2d.scene import Capacity
from kinetix_dist.level.level import NUM_WALLS

Record = TypeVar("Record")


def is_active(field: Field, of: Any) -> Array:
    """[..., slots] bool, which slots of a field are in use. `of`: the `Scene` that the field belongs to."""
    active = of.shapes.active
    if field.dims[0] == "P":
        return active[..., : of.shapes.num_vertices.shape[-1]]
    if field.dims[0] == "C":
        return active[..., active.shape[-1] - of.shapes.radius.shape[-1] :]
    if field.dims[0] == "E":
        return active[..., : field.get(of).shape[-1]]
    return {"n": active, "J": of.joints.active, "T": of.thrusters.active, "S": of.springs.active}[field.dims[0]]


def shuffled_slots(capacity: Capacity, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """What `take_slots` takes, for a level: walls stay where they are."""
    polygons = np.concatenate([np.arange(NUM_WALLS), NUM_WALLS + rng.permutation(capacity.polygons - NUM_WALLS)])
    circles = rng.permutation(capacity.circles)
    return {
        "n": np.concatenate([polygons, capacity.polygons + circles]),
        "P": polygons,
        "C": circles,
        "J": rng.permutation(capacity.joints),
        "T": rng.permutation(capacity.thrusters),
    }


def take_slots(record: Record, source: Mapping[str, Array]) -> Record:
    """The same record with its slots in another order, or fewer or more of them.

    `source`: for letters of SLOTS the old slot [new slots] that comes to each new one. Numbers of shapes are renamed to
    where these shapes go; those of shapes that are left out become 0. Traceable, for one world.
    """
    shapes = jnp.asarray(source["n"])

    def taken(field: Field) -> Array:
        x = field.get(record)
        for axis, letter in enumerate(field.dims):
            if letter in SLOTS and letter in source:
                x = jnp.take(jnp.asarray(x), jnp.asarray(source[letter]), axis=axis)
        if field.refers_to == "n":
            is_there = shapes[None, :] == x[..., None]
            x = jnp.argmax(is_there, axis=-1).astype(jnp.int32)
        return x

    return make(type(record), taken)
