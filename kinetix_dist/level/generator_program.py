"""The program that draws levels, exported: read from the compile cache instead of traced.

    keys [n] -> levels [n, ...]

A training run draws levels in its rollout and where it scores candidates. Tracing the generator took seven seconds of
Python for the three sizes, each time and in every process, also where all compiled programs are in the cache. An
exported program is traced once for a configuration and a number of levels, and adds 0.3 s to a program that calls it.
For any number, as `jax.export` can have it, it would take 2.4 s more in every process: whatever calls it is refined
before it is compiled, or looked for in the cache.
"""

from __future__ import annotations

import functools

import jax

from jax2d.scene import Array, Capacity
from kinetix_dist import prng
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level
from kinetix_dist.telemetry.exported_program import Program, Settings, current_settings, exported

KIND = "levels"  # folder in the compile cache


def draw_levels(keys: Array, capacity: Capacity, config: GeneratorConfig) -> Level:
    """[n, ...]: `generate_level` of each of the keys [n], which are consumed. Works inside jit, not inside vmap."""
    data = prng.key_data(keys)
    shape = jax.ShapeDtypeStruct(data.shape, data.dtype)
    backend, key_impl = jax.default_backend(), str(prng.key_impl(keys))
    return _program(capacity, config, backend, key_impl, shape, current_settings())(data)


@functools.cache
def _program(
    capacity: Capacity,
    config: GeneratorConfig,
    backend: str,
    key_impl: str,
    keys: jax.ShapeDtypeStruct,
    settings: Settings,
) -> Program:
    """`key_data` of `keys`, [n, ...] uint32, -> levels [n, ...]."""

    def one(data: Array) -> Level:
        return generate_level(prng.wrap_key_data(data, impl=key_impl), capacity, config)

    del backend  # for which it is exported
    return exported(KIND, (key_impl, capacity, config), jax.vmap(one), [keys], settings)
