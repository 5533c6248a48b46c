"""Columns of a shard: transitions as an Arrow table, a row each, and back.

A column with more than one number a transition holds lists of a fixed size, in row-major order; the manifest has their
shapes.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from kinetix_dist.checkpoint import flatten_arrays, unflatten_arrays
from kinetix_dist.data.manifest import column_of, named_shapes

COMPRESSION = "zstd"
# Stores byte i of all numbers together: neighbours have similar exponents, which zstd compresses well.
SPLIT_BYTES = "BYTE_STREAM_SPLIT"


class Transitions(NamedTuple):
    """N transitions of L levels; the rows of an episode are contiguous, in the order of its steps."""

    static_obs: Any  # [L, ...] of each level
    dynamic_obs: Any  # [N, ...], seen by the policy before it acted
    level: np.ndarray  # [N] int32, index into static_obs
    actions: np.ndarray  # [N, A], or [N] in a flat space: executed actions
    rewards: np.ndarray  # [N] float32
    done: np.ndarray  # [N] bool, the episode ended with this step
    solved: np.ndarray  # [N] bool, it ended so because it was solved
    timed_out: np.ndarray  # [N] bool, it ended so at the time limit
    first: np.ndarray  # [N] bool, first step of an episode
    log_prob: np.ndarray  # [N] float32, of the action under the policy, over the dimensions that the level obeys
    chosen_by: np.ndarray  # [N] int8, see `ChosenBy`
    episode: np.ndarray  # [N] int64, first row of the episode, counted in the whole data set
    step: np.ndarray  # [N] int32, in its episode
    policy_version: np.ndarray  # [N] int32, updates that the policy had learned from


ROW_FIELDS = tuple(name for name in Transitions._fields if name not in ("static_obs", "dynamic_obs"))
ACTION, REWARD = "action", "reward"
COLUMN_NAMES = {"actions": ACTION, "rewards": REWARD}  # of the fields whose columns have other names
ROW_TYPES = (  # of all columns except actions and observations
    dict.fromkeys(("done", "solved", "timed_out", "first"), np.bool_)
    | dict.fromkeys((REWARD, "log_prob"), np.float32)
    | dict.fromkeys(("level", "step", "policy_version"), np.int32)
    | {"chosen_by": np.int8, "episode": np.int64}
)


def to_parquet(rows: Transitions) -> bytes:
    """Return the content of a shard. The same rows give the same bytes."""
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


def from_parquet(
    content: bytes, static_obs: Any, shapes: Any, actions: jax.ShapeDtypeStruct, *, num_rows: int | None = None
) -> Transitions:
    """Return the rows of a shard.

    Args:
        content: the file.
        static_obs: [L, ...] of each level, for the result.
        shapes: `observation_shapes` of the dynamic observation.
        actions: [any, ...], as the action space stores them.
        num_rows: that the file must have; `None` if any number is valid.

    Raises:
        ValueError, pa.ArrowException: the content is damaged, or has other columns than a shard.
    """
    file = pq.ParquetFile(pa.BufferReader(content))
    if num_rows is not None and file.metadata.num_rows != num_rows:
        raise ValueError(f"it has {file.metadata.num_rows:,} rows, and {num_rows:,} in the index")
    named = named_shapes(shapes)
    expected = {column_of(name): _arrow_type(leaf.dtype, leaf.shape[1:]) for name, leaf in named.items()}
    expected |= {name: pa.from_numpy_dtype(dtype) for name, dtype in ROW_TYPES.items()}
    expected[ACTION] = _arrow_type(actions.dtype, actions.shape[1:])
    for name, arrow_type in expected.items():
        _check_type(file.schema_arrow, name, arrow_type)
    table = file.read(columns=list(expected))
    dynamic = {
        name: _array(table, column_of(name)).reshape(table.num_rows, *leaf.shape[1:]) for name, leaf in named.items()
    }
    wanted = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct((table.num_rows, *leaf.shape[1:]), leaf.dtype), shapes)
    fields = {name: _array(table, COLUMN_NAMES.get(name, name)) for name in ROW_FIELDS}
    return Transitions(static_obs=static_obs, dynamic_obs=unflatten_arrays(wanted, dynamic), **fields)


def joined(parts: list[Transitions]) -> Transitions:
    """Return the rows of several shards, in their order."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    rows = jax.tree.map(lambda *xs: np.concatenate(xs), *(part._replace(static_obs=None) for part in parts))
    return rows._replace(static_obs=first.static_obs)


def picked(rows: Transitions, index: Any) -> Transitions:
    """Return the rows that an index or a mask selects."""
    return jax.tree.map(lambda x: x[index], rows._replace(static_obs=None))._replace(static_obs=rows.static_obs)


def _column(array: np.ndarray) -> pa.Array:
    if array.ndim == 1:
        return pa.array(array)
    flat = np.ascontiguousarray(array).reshape(len(array), -1)
    return pa.FixedSizeListArray.from_arrays(pa.array(flat.reshape(-1)), flat.shape[1])


def _leaf(name: str, array: np.ndarray) -> str:
    """Path of a column in the file."""
    return name if array.ndim == 1 else f"{name}.list.element"


def _arrow_type(dtype: Any, shape: tuple[int, ...]) -> pa.DataType:
    """Return the type of a column with arrays of this shape in its rows."""
    value = pa.from_numpy_dtype(np.dtype(dtype))
    return pa.list_(value, math.prod(shape)) if shape else value


def _check_type(schema: pa.Schema, name: str, expected: pa.DataType) -> None:
    """Raise ValueError if a column is missing, comes twice or has another type."""
    if schema.names.count(name) != 1:
        raise ValueError(f"column {name} is missing" if name not in schema.names else f"column {name} comes twice")
    stored = schema.field(name).type
    if not stored.equals(expected):
        raise ValueError(f"column {name} has {stored}, not {expected}")


def _array(table: pa.Table, name: str) -> np.ndarray:
    column = table.column(name).combine_chunks()
    values = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
    if column.null_count or values.null_count:
        raise ValueError(f"column {name} has {column.null_count or values.null_count:,} missing values")
    array = values.to_numpy(zero_copy_only=False)
    return array if values is column else array.reshape(table.num_rows, -1)
