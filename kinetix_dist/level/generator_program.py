"""The program that draws levels, exported: read from the compile cache instead of traced.

    keys [n] -> levels [n, ...], for any n

A training run draws levels in its rollout and where it scores candidates. Tracing the generator took seven seconds of
Python for the three sizes, each time and in every process, also where all compiled programs are in the cache. An
exported program is traced once for a configuration, and adds 0.3 s to a program that calls it.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import export

from jax2d.scene import Array, Capacity
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level
from kinetix_dist.telemetry.exported_program import Program, Settings, current_settings, exported

KIND = "levels"  # folder in the compile cache


def draw_levels(keys: Array, capacity: Capacity, config: GeneratorConfig) -> Level:
    """[n, ...]: `generate_level` of each of the keys [n], which are consumed. Works inside jit, not inside vmap."""
    data = jax.random.key_data(keys)
    backend, key_impl = jax.default_backend(), str(jax.random.key_impl(keys))
    program = _program(capacity, config, backend, key_impl, data.shape[1:], current_settings())
    return program(data)


@functools.cache
def _program(
    capacity: Capacity,
    config: GeneratorConfig,
    backend: str,
    key_impl: str,
    key_shape: tuple[int, ...],
    settings: Settings,
) -> Program:
    """`key_data` [n, ...] uint32 -> levels [n, ...]."""

    def one(data: Array) -> Level:
        return generate_level(jax.random.wrap_key_data(data, impl=key_impl), capacity, config)

    del backend  # for which it is exported
    (number,) = export.symbolic_shape("n")
    keys = jax.ShapeDtypeStruct((number, *key_shape), jnp.uint32)
    return exported(KIND, (key_impl, capacity, config), jax.vmap(one), [keys], settings)
