"""Lazy reader of the offline data of the public Kinetix package: trajectories of states, read with tensorstore.

`kinetix.data` of kinetix-env 3.0.2 loads the same layout (`ZarrTrajDataSource`): a zarr group of format 2.
Each array in it is a shard of records [trajectories, steps], and each field of a record has an axis of length 1 before
its own axes:

    action, action_mask        [dimensions]        executed in this state; which dimensions something in the level obeys
    done                       []                  an episode ended
    env_state/timestep         []                  environment steps since its start
    env_state/polygon/position [polygons, 2]       and so on: the leaves of `EnvState` by their paths

A trajectory stays on one level, whose episodes follow each other. Fields that a reader does not need are not decoded
to arrays; zarr-python 3 does not have records with such fields, and tensorstore, which checkpoints need anyway, does.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from kinetix_dist.data.manifest import DatasetError, quoted
from kinetix_dist.text_files import read_json

STATE = "env_state/"
MAX_REASON = 200  # characters
MAX_COUNT = 2**31  # trajectories of a shard, or their steps: sums and products fit into 64 bits
CACHE_BYTES = 1 << 30  # decoded chunks: all fields of a chunk are decoded at once
_SHAPE_FIELDS = (
    "position", "rotation", "velocity", "angular_velocity", "inverse_mass", "friction", "restitution",
    "collision_mode", "active",
)  # fmt: skip
_JOINT_FIELDS = (
    "a_index", "b_index", "a_relative_pos", "b_relative_pos", "active", "motor_speed", "motor_power", "motor_on",
    "motor_has_joint_limits", "min_rotation", "max_rotation", "is_fixed_joint", "rotation",
)  # fmt: skip
_THRUSTER_FIELDS = ("object_index", "relative_position", "rotation", "power", "active")
STATE_FIELDS = (
    "timestep", "gravity",
    *(f"polygon/{name}" for name in (*_SHAPE_FIELDS, "n_vertices", "vertices")),
    *(f"circle/{name}" for name in (*_SHAPE_FIELDS, "radius")),
    *(f"joint/{name}" for name in _JOINT_FIELDS),
    *(f"thruster/{name}" for name in _THRUSTER_FIELDS),
    "polygon_shape_roles", "circle_shape_roles", "polygon_densities", "circle_densities",
    "motor_bindings", "motor_auto", "thruster_bindings",
    "acc_rr_manifolds/active", "acc_cr_manifolds/active", "acc_cc_manifolds/active",
)  # fmt: skip
FIELDS = ("action", "action_mask", "done", *(STATE + name for name in STATE_FIELDS))


class KinetixOffline:
    """A folder of shards. Faults raise `DatasetError`, one line."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        shapes = _shapes(folder)
        self.shards = list(shapes)  # names of the shards with trajectories, sorted
        self.num_steps = shapes[self.shards[0]][1]  # of each trajectory
        if odd := [name for name, shape in shapes.items() if shape[1] != self.num_steps]:
            raise DatasetError(
                f"{folder / odd[0]} has trajectories of {shapes[odd[0]][1]} steps, and {self.shards[0]} of "
                f"{self.num_steps}; move it into a folder of its own"
            )
        self._starts = np.cumsum([0, *(shape[0] for shape in shapes.values())])
        self._opened: tuple[str, dict[str, Any]] = "", {}  # fields of the shard that was read last

    def __len__(self) -> int:
        """Trajectories."""
        return int(self._starts[-1])

    def name(self, number: int) -> str:
        """Shard and row of a trajectory: "shard_00003/17"."""
        shard = int(np.searchsorted(self._starts, number, side="right")) - 1
        return f"{self.shards[shard]}/{number - self._starts[shard]}"

    def read(self, start: int, stop: int, fields: Sequence[str] = FIELDS) -> dict[str, np.ndarray]:
        """Fields [stop - start, steps, ...] of these trajectories. Raises DatasetError if the data lack them."""
        if not 0 <= start < stop <= len(self):
            raise DatasetError(f"{self.folder} has trajectories 0 to {len(self) - 1}, not {start} to {stop - 1}")
        parts = []
        for shard, name in enumerate(self.shards):
            first, end = self._starts[shard], self._starts[shard + 1]
            if first < stop and start < end:
                rows = slice(int(max(start - first, 0)), int(min(stop, end) - first))
                parts.append(self._read_shard(name, rows, fields))
        return {field: np.concatenate([part[field] for part in parts]) for field in fields}

    def _read_shard(self, name: str, rows: slice, fields: Sequence[str]) -> dict[str, np.ndarray]:
        arrays = {field: self._array(name, field) for field in fields}
        try:  # all fields of a chunk are requested at once, so that it is decoded once
            pending = {field: array[rows].read() for field, array in arrays.items()}
            return {field: np.asarray(future.result())[:, :, 0] for field, future in pending.items()}
        except ValueError as error:
            raise DatasetError(
                f"{self.folder / name} is damaged or not whole: {_reason(error)}; download it again"
            ) from None

    def _array(self, name: str, field: str) -> Any:
        import tensorstore

        if self._opened[0] != name:
            self._opened = name, {}
        opened = self._opened[1]
        if field in opened:
            return opened[field]
        spec = {
            "driver": "zarr",
            "kvstore": {"driver": "file", "path": f"{self.folder / name}/"},
            "field": field,
            "fill_missing_data_reads": False,  # a chunk that was not downloaded is an error, not zeros
        }
        try:
            array = tensorstore.open(spec, read=True, open=True, context=self._context).result()
        except ValueError as error:
            raise DatasetError(f"{self.folder / name}: field {field!r} cannot be read: {_reason(error)}") from None
        if len(array.shape) < 3 or array.shape[2] != 1:
            raise DatasetError(
                f"{self.folder / name}: field {field!r} has shape {list(array.shape)}, not [trajectories, steps, 1, "
                "...]; this is no trajectory data of the public Kinetix package"
            )
        opened[field] = array
        return array

    @functools.cached_property
    def _context(self) -> Any:
        import tensorstore

        return tensorstore.Context({"cache_pool": {"total_bytes_limit": CACHE_BYTES}})


def _shapes(folder: Path) -> dict[str, list[int]]:
    """Shapes of the arrays of a group that are not empty, in the order of their names."""
    if not folder.is_dir():
        raise DatasetError(f"{folder} is no directory; give a split of Kinetix' offline data, such as data/1M/s")
    if (folder / "zarr.json").is_file():
        raise DatasetError(f"{folder} is of zarr format 3; Kinetix' offline data are of format 2")
    files = sorted(folder.glob("*/.zarray"))
    if not files:
        deeper = sorted(path.parent.parent for path in (*folder.glob("*/*/.zarray"), *folder.glob("*/*/*/.zarray")))
        raise DatasetError(
            f"{folder} holds no zarr arrays; give {deeper[0] if deeper else 'a split of the data, such as data/1M/s'}"
        )
    shapes = {}
    for file in files:
        try:
            content = read_json(file)
        except (OSError, ValueError) as error:
            raise DatasetError(f"{file} cannot be read ({error}); download it again") from None
        shape = content.get("shape") if isinstance(content, dict) else None
        if not _is_shape(shape):
            raise DatasetError(f"{file}: shape is {quoted(shape)}, not [trajectories, steps]; download it again")
        if shape[0] > 0:
            shapes[file.parent.name] = shape
    if not shapes:
        raise DatasetError(f"{folder} has {len(files)} arrays, and no trajectory in any")
    return shapes


def _is_shape(shape: Any) -> TypeGuard[list[int]]:
    """Return whether this is [trajectories, steps]."""
    is_counts = isinstance(shape, list) and all(type(n) is int and 0 <= n <= MAX_COUNT for n in shape)
    return is_counts and len(shape) == 2 and shape[1] > 0


def _reason(error: ValueError) -> str:
    """Return the message of tensorstore without specifications, lists and places in its source."""
    text = " ".join(str(error).split()).split(" [", 1)[0].split(" is not one of", 1)[0]
    return text.rsplit('"zarr" driver: ', 1)[-1][:MAX_REASON]
