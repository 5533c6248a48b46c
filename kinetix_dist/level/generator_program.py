"""The program that draws levels, exported: read from the compile cache instead of traced.

    keys [n] -> levels [n, ...], for any n

A training run draws levels in its rollout and where it scores candidates. Tracing the generator took seven seconds of
Python for the three sizes, each time and in every process, also where all compiled programs are in the cache. An
exported program is traced once for a configuration, and adds 0.3 s to a program that calls it.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax import export

import jax2d
import kinetix_dist
from jax2d.scene import Array, Capacity
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level
from kinetix_dist.level.walls import empty_level
from kinetix_dist.telemetry.cached_files import cached

KIND = "levels"  # folder in the compile cache
# Settings of JAX that change what a traced program computes, by their context managers.
_SETTINGS: dict[str, Callable[[Any], Any]] = {
    "jax_enable_x64": jax.enable_x64,
    "jax_threefry_partitionable": jax.threefry_partitionable,
    "jax_numpy_dtype_promotion": jax.numpy_dtype_promotion,
    "jax_default_matmul_precision": jax.default_matmul_precision,
}


def draw_levels(keys: Array, capacity: Capacity, config: GeneratorConfig) -> Level:
    """[n, ...]: `generate_level` of each of the keys [n], which are consumed. Works inside jit, not inside vmap."""
    data = jax.random.key_data(keys)
    settings = tuple((name, getattr(jax.config, name)) for name in _SETTINGS)
    backend, key_impl = jax.default_backend(), str(jax.random.key_impl(keys))
    program = _program(capacity, config, backend, key_impl, data.shape[1:], settings)
    return jax.tree.unflatten(jax.tree.structure(empty_level(capacity)), program.call(data))


@functools.cache
def _program(
    capacity: Capacity,
    config: GeneratorConfig,
    backend: str,
    key_impl: str,
    key_shape: tuple[int, ...],
    settings: tuple[tuple[str, Any], ...],
) -> export.Exported:
    """Of `key_data` [n, ...] uint32, the leaves of levels."""

    def one(data: Array) -> list[Array]:
        level = generate_level(jax.random.wrap_key_data(data, impl=key_impl), capacity, config)
        return jax.tree.leaves(level)

    def make() -> bytes:
        (number,) = export.symbolic_shape("n")
        keys = jax.ShapeDtypeStruct((number, *key_shape), jnp.uint32)
        with contextlib.ExitStack() as stack:  # a thread begins with those of the process
            for name, value in settings:
                stack.enter_context(_SETTINGS[name](value))
            return bytes(export.export(jax.jit(jax.vmap(one)))(keys).serialize())

    asked_for = repr((_SOURCES, jax.__version__, backend, key_impl, capacity, config, settings))
    # In a thread of its own: what is being traced here, and on which mesh, is not part of it.
    with ThreadPoolExecutor(1) as thread:
        content = thread.submit(cached, KIND, asked_for, make).result()
    return export.deserialize(bytearray(content))


def _sources() -> str:
    """A checksum of all modules that may say what a level is."""
    digest = hashlib.sha256()
    for package in (jax2d, kinetix_dist):
        folder = Path(package.__path__[0])
        for file in sorted(folder.rglob("*.py")):
            content = file.read_bytes()
            digest.update(f"{file.relative_to(folder)} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


# Of the modules as this process has them: a file may change while it runs.
_SOURCES = _sources()
