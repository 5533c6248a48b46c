"""What a checkpoint holds of a run: names of its parts, and the level buffer read back."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np

from kinetix_dist.checkpoint import select_arrays, unflatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.level_buffer import LevelBuffer, keep_best
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.level import Level

LEARNER = "learner"  # parameters, optimiser, counters
BUFFER = "buffer"  # levels in use
ACTING = "acting"  # split placement: parameters that play the batch in flight


def stored_buffer(config: TrainConfig, arrays: Mapping[str, np.ndarray] | None) -> LevelBuffer | None:
    """The level buffer of a checkpoint; None when there is none in it."""
    stored = select_arrays(arrays or {}, BUFFER)
    if not stored:
        return None
    curriculum = config.curriculum

    def template() -> LevelBuffer:
        level = one_level(config)
        count = jnp.zeros(curriculum.buffer_size, jnp.int32)
        levels = jax.tree.map(lambda x: jnp.broadcast_to(x, (curriculum.buffer_size, *x.shape[1:])), level)
        return keep_best(levels, count, count, size=curriculum.buffer_size, policy_version=0)

    return unflatten_arrays(jax.eval_shape(template), stored)


def one_level(config: TrainConfig) -> Level:
    """Any level of the run, [1, ...]: for shapes and dtypes."""
    level = generate_level(jax.random.key(0), config.env.capacity, config.curriculum.generator)
    return jax.tree.map(lambda x: x[None], level)
