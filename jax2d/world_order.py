"""Order of worlds by structure: worlds with the same joints, bodies and pairs stand side by side.

On a GPU one thread steps one world, and a warp of 32 worlds takes the time of the longest of its branches. Worlds of
one structure take more of the same branches. A world moves by itself, so its bits are the same at any place.

    order = order_by_structure(scene)         # of a batch, [W, ...]
    order.sort(x)                             # [W, ...] -> [W, ...]: like worlds side by side
    order.restore(order.sort(x))              # x again

`Engine.pack_sorted` packs scenes and states in this order.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.fields import Array
from jax2d.scene import JointKind, Scene, capacity_of, only_what_acts

# Counts of `structure_of`, the first one decides first. Joints come first: a warp goes through each kind on its own.
STRUCTURE = (
    *(f"{kind.name.lower()}_joints" for kind in JointKind),
    "movable_bodies",
    "circles",
    "polygons",
    "polygon_pairs",
    "polygon_circle_pairs",
    "circle_pairs",
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class WorldOrder:
    """A permutation of the worlds of a batch and its inverse."""

    worlds: Array  # [W] int32, number of the world that stands at each place
    places: Array  # [W] int32, place at which each world stands

    def sort(self, tree: Any, axis: int = 0) -> Any:
        """Arrays with worlds along `axis` (-1 for packed tables), in the order of places."""
        return _take(tree, self.worlds, axis)

    def restore(self, tree: Any, axis: int = 0) -> Any:
        """The inverse of `sort`."""
        return _take(tree, self.places, axis)


def structure_of(scene: Scene) -> jax.Array:
    """[..., len(STRUCTURE)] int32, counts of what acts in each scene, in the order of `STRUCTURE`.

    Works for one scene and for any batch, also inside jit. Pairs are those that can touch. Slots that are not active
    count nowhere.
    """
    polygons = capacity_of(scene).polygons
    scene = only_what_acts(scene)
    shapes, joints, active = scene.shapes, scene.joints, jnp.asarray(scene.shapes.active)
    is_movable = (jnp.asarray(shapes.inverse_mass) > 0) | (jnp.asarray(shapes.inverse_inertia) > 0) | shapes.kinematic
    meets = jnp.asarray(shapes.can_touch)  # each pair once, at [lower, higher]
    counted = [
        *(joints.active & joints.is_kind(kind) for kind in JointKind),
        is_movable,
        active[..., polygons:],
        active[..., :polygons],
        _flat(meets[..., :polygons, :polygons]),
        _flat(meets[..., :polygons, polygons:]),
        _flat(meets[..., polygons:, polygons:]),
    ]
    return jnp.stack([mask.sum(-1, dtype=jnp.int32) for mask in counted], axis=-1)


def order_by_structure(scene: Scene) -> WorldOrder:
    """The order in which like worlds of a batch of scenes, [W, ...], stand side by side; works inside jit.

    It is lexicographic in `structure_of`. Worlds of equal structure stay in the order that they have. Raises ValueError
    for a single scene.
    """
    return sorting(structure_of(scene))


def sorting(structure: Array) -> WorldOrder:
    """The order in which rows of `structure`, [W, counts], rise; equal rows stay in the order that they have."""
    if np.ndim(structure) != 2:
        raise ValueError(f"structure has shape {np.shape(structure)}; worlds of one batch have [worlds, counts]")
    numbers = jnp.arange(np.shape(structure)[0], dtype=jnp.int32)
    counts = [jnp.asarray(structure)[:, i] for i in range(np.shape(structure)[1])]
    *_, worlds = jax.lax.sort((*counts, numbers), num_keys=len(counts), is_stable=True)
    return WorldOrder(worlds=worlds, places=jnp.zeros_like(numbers).at[worlds].set(numbers, unique_indices=True))


def _take(tree: Any, index: Array, axis: int) -> Any:
    # "clip" as all of a permutation is in range: by default XLA compares every index.
    return jax.tree.map(lambda x: jnp.take(x, index, axis=axis, mode="clip", unique_indices=True), tree)


def _flat(pairs: jax.Array) -> jax.Array:
    return pairs.reshape(*pairs.shape[:-2], pairs.shape[-2] * pairs.shape[-1])
