"""The program that draws levels, exported: read from the program cache instead of traced.

    keys [n] -> levels [n, ...]

A training run draws levels in its rollout and where it scores candidates. Tracing the generator took seven seconds of
Python for the three sizes, each time and in every process, also where all compiled programs are in the cache. An
exported program is traced once for a configuration and a number of levels, and adds 0.3 s to a program that calls it.
For any number, as `jax.export` can have it, it would take 2.4 s more in every process: whatever calls it is refined
before it is compiled, or looked for in the cache.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax

from jax2d.scene import Array, Capacity
from kinetix_dist import prng
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level
from kinetix_dist.program_cache import ProgramKey, exported

CACHE = "levels"  # folder in the program cache


def draw_levels(keys: Array, capacity: Capacity, config: GeneratorConfig) -> Level:
    """Levels [n, ...] of `generate_level` by keys [n], which are consumed. Works inside jit, not inside vmap."""
    return _program(capacity, config, jax.default_backend(), str(prng.key_impl(keys)))(prng.key_data(keys))


@functools.cache
def _program(capacity: Capacity, config: GeneratorConfig, backend: str, key_impl: str) -> Callable[[Array], Level]:
    """(`key_data` [n, ...] uint32 of keys) -> levels [n, ...]."""

    def draw(data: Array) -> Level:
        keys = prng.wrap_key_data(data, impl=key_impl)
        return jax.vmap(lambda key: generate_level(key, capacity, config))(keys)

    del backend  # for which it is exported
    return exported(draw, ProgramKey(kind=CACHE, module=__name__, depends_on=(key_impl, capacity, config)))
