"""Placement of arrays: one mesh axis, "data", over all devices of all processes.

Worlds are sharded over it (each device owns a contiguous block of them, in the order of devices; `division.py` says
which where they cannot be divided evenly), parameters and counters are replicated. A process that is one of several
hands in the worlds of its own devices and gets a global array; with one process the functions are plain transfers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from jax2d.scene import Array
from kinetix_dist.learner.division import Division

DATA_AXIS = "data"


def data_mesh(devices: list[Any] | None = None) -> Mesh:
    """A mesh over `devices`, by default all devices of all processes."""
    return Mesh(np.asarray(jax.devices() if devices is None else devices), (DATA_AXIS,))


def replicated(mesh: Mesh) -> NamedSharding:
    return NamedSharding(mesh, PartitionSpec())


def sharded(mesh: Mesh, *, axis: int = 0) -> NamedSharding:
    """Axis number `axis` divided over the mesh: 0 for [W, ...], 1 for [T, W, ...], -1 is not supported."""
    return NamedSharding(mesh, PartitionSpec(*[None] * axis, DATA_AXIS))


def on_devices(function: Callable[..., Any], mesh: Mesh, *, in_specs: Any, out_specs: Any) -> Callable[..., Any]:
    """`jax.shard_map` of a function that may ignore some of its inputs. What is replicated is not checked.

    The compiler of jax 0.11 ends the process (a fault in Shardy's ManualComputationUnusedInputsPattern) on some
    programs of several devices that do not use all their inputs, or have inputs that hold nothing. So those that hold
    nothing are left out, and a barrier, which costs nothing, uses the others.
    """

    def call(*inputs: Any) -> Any:
        leaves, structure = jax.tree.flatten(inputs)
        specs = jax.tree.leaves(jax.tree.broadcast(tuple(in_specs), inputs))
        used = [index for index, leaf in enumerate(leaves) if np.size(leaf)]

        def with_all_used(*values: Any) -> Any:
            given = iter(jax.lax.optimization_barrier(values))

            def inside(leaf: Any, spec: PartitionSpec) -> Any:
                if np.size(leaf):
                    return next(given)
                return jnp.zeros(NamedSharding(mesh, spec).shard_shape(np.shape(leaf)), leaf.dtype)

            return function(*jax.tree.unflatten(structure, map(inside, leaves, specs)))

        with_specs = tuple(specs[index] for index in used)
        on_mesh = jax.shard_map(with_all_used, mesh=mesh, in_specs=with_specs, out_specs=out_specs, check_vma=False)
        return on_mesh(*(leaves[index] for index in used))

    return call


def replicate(tree: Any, mesh: Mesh) -> Any:
    """Puts the same values on every device; every process must pass the same."""
    return jax.tree.map(lambda x: _place(x, replicated(mesh), global_shape=np.shape(x)), tree)


def shapes_of_replicated(shapes: Any, mesh: Mesh) -> Any:
    """Shapes that `replicate` gives for arrays of these shapes."""
    whole = replicated(mesh)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=whole), shapes)


def shard_worlds(tree: Any, mesh: Mesh, *, axis: int = 0) -> Any:
    """Divides the worlds of this process (axis `axis` of every leaf) over its devices of the mesh."""
    num_processes = len({device.process_index for device in mesh.devices.flat})
    num_local = mesh.devices.size // num_processes

    def place(x: Array) -> Array:
        shape = np.shape(x)
        if shape[axis] % num_local:
            raise ValueError(
                f"{shape[axis]} worlds cannot be divided over {num_local} devices; use a multiple of {num_local}"
            )
        return _place(x, sharded(mesh, axis=axis), (*shape[:axis], shape[axis] * num_processes, *shape[axis + 1 :]))

    return jax.tree.map(place, tree)


def spread_worlds(tree: Any, mesh: Mesh, division: Division, *, axis: int = 0) -> Any:
    """Puts worlds into the slots of their parts. Every process hands in the worlds of all, each once."""

    def place(x: Array) -> Array:
        rows = own_rows(mesh, division, np.shape(x)[axis])
        return x if np.array_equal(rows, np.arange(np.shape(x)[axis])) else np.take(x, rows, axis=axis)

    return shard_worlds(jax.tree.map(place, tree), mesh, axis=axis)


def own_worlds(tree: Any, mesh: Mesh, division: Division) -> Any:
    """Worlds of this process as numpy, each once and in order, from arrays that `spread_worlds` or a program gave."""
    mine = np.array([device.process_index == jax.process_index() for device in mesh.devices.flat])
    is_counted = division.is_counted[mine].reshape(-1)

    def take(x: jax.Array) -> np.ndarray:
        shards = sorted(x.addressable_shards, key=lambda shard: shard.index[0].start or 0)
        rows = np.concatenate([np.asarray(shard.data) for shard in shards])
        return rows[np.repeat(is_counted, len(rows) // len(is_counted))]

    return jax.tree.map(take, tree)


def own_rows(mesh: Mesh, division: Division, num_worlds: int) -> np.ndarray:
    """Number of the world in each slot of this process's devices, of all worlds, each once and in order."""
    mine = [device.process_index == jax.process_index() for device in mesh.devices.flat]
    return division.spread(num_worlds).reshape(mesh.devices.size, -1)[mine].reshape(-1)


def local_values(tree: Any) -> Any:
    """Numpy copies of replicated arrays, without communication."""
    return jax.tree.map(
        lambda x: np.asarray(x.addressable_data(0)) if isinstance(x, jax.Array) else np.asarray(x), tree
    )


def _place(x: Array, sharding: NamedSharding, global_shape: tuple[int, ...]) -> Array:
    if sharding.is_fully_addressable:
        return jax.device_put(x, sharding)
    if isinstance(x, jax.Array) and x.sharding == sharding:
        return x
    return jax.make_array_from_process_local_data(sharding, np.asarray(x), global_shape)
