"""Sources of fresh levels: objects that draw levels of one capacity from a key."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import jax

from jax2d.scene import Array, Capacity
from kinetix_dist import prng
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.goal_following import generate_goal_following_level
from kinetix_dist.level.level import Level


class LevelGenerator(Protocol):
    """Pure; works inside jit."""

    def generate(self, key: Array, num_levels: int) -> Level:
        """[num_levels, ...] valid levels. Consumes `key`."""


@dataclasses.dataclass(frozen=True)
class RandomLevels:
    """The random levels of `generator.py`."""

    capacity: Capacity
    config: GeneratorConfig

    def generate(self, key: Array, num_levels: int) -> Level:
        return generate_levels(key, num_levels, self.capacity, self.config)


@dataclasses.dataclass(frozen=True)
class GoalFollowingLevels:
    """The levels of `goal_following.py`, with one kind of body."""

    capacity: Capacity
    morphology: str  # of MORPHOLOGIES

    def generate(self, key: Array, num_levels: int) -> Level:
        keys = prng.split(key, num_levels)
        return jax.vmap(lambda one: generate_goal_following_level(one, self.capacity, self.morphology))(keys)
