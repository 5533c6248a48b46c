"""Pytrees as flat dictionaries of named numpy arrays, which is what a checkpoint stores.

A name is the path through the pytree, "params/encoder/kernel". Restoring needs a template of the same structure, and
every difference between the two is an error that names the array.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist import prng
from kinetix_dist.errors import MAX_QUOTED, OneLineError, quoted, shortened
from kinetix_dist.text_files import loads_json


class ArrayMismatchError(OneLineError, ValueError):
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


TRAINED = frozenset(("learner", "params", "average", "optimizer"))  # in the path of an array that training makes


def name_not_finite(arrays: Mapping[str, np.ndarray]) -> str | None:
    """Return the name of a parameter, or of another array of a learner, that holds NaN or infinity; None: none does.

    Arrays beside them may hold such numbers: scores of a curriculum do.
    """
    for name, array in arrays.items():
        is_number = jnp.issubdtype(np.asarray(array).dtype, jnp.floating)
        if is_number and not TRAINED.isdisjoint(name.split("/")) and not np.isfinite(array).all():
            return name
    return None


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


MAX_HEADER_BYTES = 100_000_000  # as in the reference implementation
_PICKLE_STARTS = (b"BZh", b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05", b"\x1f\x8b", b"PK")  # bare or compressed


class SafetensorsError(OneLineError, ValueError):
    """A file that cannot be read, and why."""


def read_safetensors(path: Path) -> dict[str, np.ndarray]:
    """Every array of a file by name. Raises SafetensorsError naming the file, and OSError."""
    content = path.read_bytes()
    if content.startswith(_PICKLE_STARTS):
        raise SafetensorsError(
            f"{path} is a pickle or an archive, which could run anything when it is read; write its parameters as "
            "safetensors where you trust it (kinetix.util.saving.save_pretrained_checkpoint)"
        )
    if len(content) < 8:
        raise SafetensorsError(f"{path} has {len(content)} bytes: it is no safetensors file")
    length = int.from_bytes(content[:8], "little")
    if length > min(MAX_HEADER_BYTES, len(content) - 8):
        raise SafetensorsError(f"{path} is cut or no safetensors file: its header would have {length:,} bytes")
    try:
        header = loads_json(content[8 : 8 + length])
        entries = {name: entry for name, entry in header.items() if name != "__metadata__"}
    except (ValueError, AttributeError, RecursionError) as error:
        raise SafetensorsError(f"{path} is no safetensors file: its header cannot be read") from error
    return {name: _array(path, name, entry, memoryview(content)[8 + length :]) for name, entry in entries.items()}


def _array(path: Path, name: str, entry: Any, data: memoryview) -> np.ndarray:
    shown = shortened(name, MAX_QUOTED)
    try:
        dtype, shape, (begin, end) = entry["dtype"], list(entry["shape"]), entry["data_offsets"]
        if any(type(number) is not int for number in (*shape, begin, end)):
            raise TypeError("sizes and offsets must be whole numbers")
    except (KeyError, TypeError, ValueError) as error:
        raise SafetensorsError(f"{path}: the entry of {shown} cannot be read") from error
    if dtype != "F32":
        raise SafetensorsError(f"{path}: {shown} is {shortened(str(dtype), MAX_QUOTED)}; only F32 is read")
    is_whole = 0 <= begin <= end <= len(data) and all(size >= 0 for size in shape)
    if not is_whole or end - begin != 4 * math.prod(shape):
        raise SafetensorsError(
            f"{path} is cut or damaged: {shown} {quoted(shape)} does not lie in bytes {begin} to {end}"
        )
    try:
        return np.frombuffer(data[begin:end], "<f4").reshape(shape).copy()
    except ValueError as error:
        raise SafetensorsError(f"{path}: {shown} has a shape that no array has, {quoted(shape)}") from error
