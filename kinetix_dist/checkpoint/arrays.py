"""Pytrees as flat dictionaries of named numpy arrays, which is what a checkpoint stores.

A name is the path through the pytree, "params/encoder/kernel". Restoring needs a template of the same structure, and
every difference between the two is an error that names the array.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist import prng


class ArrayMismatchError(ValueError):
    """The stored arrays are not those of the structure they should be restored into."""


def flatten_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Every leaf of a pytree as a numpy array under its path; typed PRNG keys are stored as their key data.

    Leaves without elements are left out: they hold nothing, and `unflatten_arrays` knows their shape.
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    arrays = {_name(path): _to_numpy(leaf) for path, leaf in leaves}
    return {name: array for name, array in arrays.items() if array.size}


def unflatten_arrays(template: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """The pytree of `template`'s structure with the leaves of `arrays`; shapes and dtypes must agree.

    Leaves of the template may be arrays or `jax.ShapeDtypeStruct`s. The result holds numpy arrays.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    names = [_name(path) for path, _ in leaves]
    arrays = dict(arrays) | {_name(path): np.zeros(leaf.shape, leaf.dtype) for path, leaf in leaves if 0 in leaf.shape}
    if missing := sorted(set(names) - set(arrays)):
        raise ArrayMismatchError(f"array {missing[0]} is missing ({len(missing)} of {len(names)} are)")
    if extra := sorted(set(arrays) - set(names)):
        raise ArrayMismatchError(f"array {extra[0]} is not expected ({len(extra)} are not)")
    restored = []
    for name, (_, leaf) in zip(names, leaves, strict=True):
        array = np.asarray(arrays[name])
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        wanted = jax.eval_shape(prng.key_data, leaf) if is_key else leaf
        if tuple(array.shape) != tuple(wanted.shape) or array.dtype != wanted.dtype:
            raise ArrayMismatchError(
                f"array {name} is {array.dtype}{list(array.shape)}, expected {wanted.dtype}{list(wanted.shape)}"
            )
        restored.append(prng.wrap_key_data(array) if is_key else array)
    return jax.tree_util.tree_unflatten(structure, restored)


def select_arrays(arrays: Mapping[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays below `prefix/`, named without it."""
    return {name[len(prefix) + 1 :]: array for name, array in arrays.items() if name.startswith(prefix + "/")}


def _name(path: tuple[Any, ...]) -> str:
    parts = []
    for entry in path:
        for attribute in ("key", "name", "idx"):
            if hasattr(entry, attribute):
                parts.append(str(getattr(entry, attribute)))
                break
    return "/".join(parts)


def _to_numpy(leaf: Any) -> np.ndarray:
    if isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        leaf = prng.key_data(leaf)
    return np.asarray(jax.device_get(leaf))
