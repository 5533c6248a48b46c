"""Where fresh levels come from: anything that draws levels of one capacity from a key."""

from __future__ import annotations

import dataclasses
from typing import Protocol

from jax2d.scene import Array, Capacity
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level


class LevelGenerator(Protocol):
    """Pure; works inside jit."""

    def generate(self, key: Array, num_levels: int) -> Level:
        """[num_levels, ...] valid levels. Consumes `key`."""


@dataclasses.dataclass(frozen=True)
class RandomLevels:
    """Those of `generator.py`."""

    capacity: Capacity
    config: GeneratorConfig

    def generate(self, key: Array, num_levels: int) -> Level:
        return generate_levels(key, num_levels, self.capacity, self.config)
