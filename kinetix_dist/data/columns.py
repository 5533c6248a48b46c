"""Columns of a shard: transitions as an Arrow table, a row each, and back.

An array of more than one number a transition is a list of fixed size in its column, in row-major order; the manifest
has its shape.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from kinetix_dist.checkpoint import flatten_arrays, unflatten_arrays
from kinetix_dist.data.manifest import column_of, named_shapes

COMPRESSION = "zstd"
# Byte i of all numbers side by side: exponents of neighbours are alike, and zstd finds that.
SPLIT_BYTES = "BYTE_STREAM_SPLIT"


class Transitions(NamedTuple):
    """N transitions of L levels, rows of an episode side by side in the order of its steps."""

    static_obs: Any  # [L, ...] of each level
    dynamic_obs: Any  # [N, ...], what the policy saw before it acted
    level: np.ndarray  # [N] int32, index into static_obs
    actions: np.ndarray  # [N, A], or [N] in a flat space: what was executed
    rewards: np.ndarray  # [N] float32
    done: np.ndarray  # [N] bool, the episode ended with this step
    solved: np.ndarray  # [N] bool, it ended so because it was solved
    timed_out: np.ndarray  # [N] bool, it ended so at the time limit
    first: np.ndarray  # [N] bool, first step of an episode
    log_prob: np.ndarray  # [N] float32, of the action under the policy, over the dimensions that the level obeys
    chosen_by: np.ndarray  # [N] int8, see `ChosenBy`
    episode: np.ndarray  # [N] int64, number of the row in the whole data set with which the episode begins
    step: np.ndarray  # [N] int32, in its episode
    policy_version: np.ndarray  # [N] int32, updates that the policy had learned from


ROW_FIELDS = tuple(name for name in Transitions._fields if name not in ("static_obs", "dynamic_obs"))
COLUMN_NAMES = {  # where they differ
    "actions": "action",
    "rewards": "reward",
}


def to_parquet(rows: Transitions) -> bytes:
    """Content of a shard: the same rows give the same bytes."""
    arrays = {COLUMN_NAMES.get(name, name): getattr(rows, name) for name in ROW_FIELDS}
    arrays = {column_of(name): array for name, array in flatten_arrays(rows.dynamic_obs).items()} | arrays
    table = pa.table({name: _column(array) for name, array in arrays.items()})
    floats = [_leaf(name, array) for name, array in arrays.items() if array.dtype.kind == "f"]
    sink = pa.BufferOutputStream()
    pq.write_table(
        table,
        sink,
        compression=COMPRESSION,
        use_dictionary=[_leaf(name, array) for name, array in arrays.items() if array.dtype.kind != "f"],
        column_encoding=dict.fromkeys(floats, SPLIT_BYTES),
        write_statistics=False,
        store_schema=True,
    )
    return sink.getvalue().to_pybytes()


def from_parquet(content: bytes, static_obs: Any, shapes: Any) -> Transitions:
    """shapes: `observation_shapes` of the dynamic observation. Raises KeyError, ValueError or pa.ArrowException for
    content that is not of that."""
    table = pq.read_table(pa.BufferReader(content))
    num_rows = table.num_rows
    named = named_shapes(shapes)
    dynamic = {
        name: _array(table, column_of(name)).reshape(num_rows, *leaf.shape[1:]).astype(leaf.dtype, copy=False)
        for name, leaf in named.items()
    }
    wanted = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((num_rows, *leaf.shape[1:]), leaf.dtype), shapes)
    fields = {name: _array(table, COLUMN_NAMES.get(name, name)) for name in ROW_FIELDS}
    return Transitions(static_obs=static_obs, dynamic_obs=unflatten_arrays(wanted, dynamic), **fields)


def joined(parts: list[Transitions]) -> Transitions:
    """Rows of several shards, in their order."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    rows = jax.tree.map(lambda *xs: np.concatenate(xs), *(part._replace(static_obs=None) for part in parts))
    return rows._replace(static_obs=first.static_obs)


def picked(rows: Transitions, index: Any) -> Transitions:
    """Rows of these numbers, or where a mask is True."""
    return jax.tree.map(lambda x: x[index], rows._replace(static_obs=None))._replace(static_obs=rows.static_obs)


def _column(array: np.ndarray) -> pa.Array:
    if array.ndim == 1:
        return pa.array(array)
    flat = np.ascontiguousarray(array).reshape(len(array), -1)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat.reshape(-1)), flat.shape[1])


def _leaf(name: str, array: np.ndarray) -> str:
    """Path of a column in the file."""
    return name if array.ndim == 1 else f"{name}.list.element"


def _array(table: pa.Table, name: str) -> np.ndarray:
    if name not in table.column_names:
        raise KeyError(f"column {name} is missing")
    column = table.column(name).combine_chunks()
    if pa.types.is_fixed_size_list(column.type):
        return column.flatten().to_numpy(zero_copy_only=False).reshape(table.num_rows, -1)
    return column.to_numpy(zero_copy_only=False)
