"""Levels that the teacher of a PAIRED run builds, from a checkpoint of the run."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array, Capacity
from kinetix_dist import prng
from kinetix_dist.checkpoint import Checkpoint, select_arrays, unflatten_arrays
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.teacher import LevelBuilder
from kinetix_dist.level.level import Level

PARAMS_PREFIX = "curriculum/teacher/params"  # where a checkpoint's arrays keep the parameters of the teacher


@dataclasses.dataclass(frozen=True)
class TeacherLevels:
    """Levels that a teacher builds with given parameters; a `LevelGenerator`."""

    builder: LevelBuilder
    params: Any

    def generate(self, key: Array, num_levels: int) -> Level:
        return self.builder.build(self.params, prng.split(key, num_levels))[0]


def teacher_levels(checkpoint: Checkpoint, config: CurriculumConfig, capacity: Capacity) -> TeacherLevels:
    """Generator of the teacher in a checkpoint of a run with this curriculum and capacity.

    Raises ValueError for a run of another curriculum, and `ArrayMismatchError` for parameters of another network.
    """
    if config.name != "paired":
        raise ValueError(f"{checkpoint.path} is of curriculum {config.name!r}; only 'paired' has a teacher")
    builder = LevelBuilder(capacity, config.generator, config.paired)
    template = jax.eval_shape(lambda key: builder.policy.init(key, builder.first_obs()), prng.key(0))
    params = unflatten_arrays(template, select_arrays(checkpoint.arrays, PARAMS_PREFIX))
    return TeacherLevels(builder, jax.tree.map(jnp.asarray, params))
