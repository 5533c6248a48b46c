"""Levels of the random generator, for tests that need any."""

from __future__ import annotations

import jax

from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES, Level


def random_levels(size: str, number: int, *, seed: int = 0) -> Level:
    """[number, ...] as numpy."""
    keys = jax.random.split(jax.random.key(seed), number)
    return jax.device_get(jax.jit(jax.vmap(lambda key: generate_level(key, SIZES[size], GeneratorConfig())))(keys))
