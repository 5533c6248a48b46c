"""Names that the cores of a run agree on: its random streams and the parts of its checkpoints.

Everything random follows from (seed, stream, update, world): there is no generator state, and no result depends on how
worlds are spread over devices.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.config import TrainConfig
from kinetix_dist.level.level import Level
from kinetix_dist.level.walls import empty_level

LEARNER = "learner"  # parameters, optimiser, counters
START = "start"  # in place of a checkpoint: what a new run takes of an earlier one, by the names below
PARAMS, OPTIMIZER = "params", "opt_state"  # of a `LearnerState`
CURRICULUM = "curriculum"  # its state
ACTING = "acting"  # split placement: parameters that play the batch in flight
WORLDS = "worlds"  # those that go on into the next update
PROPOSING = "proposing"  # split placement, curricula that observe: the state that proposed the batch in flight


def one_level(config: TrainConfig) -> Level:
    """A level in arrays of the run, [1, ...], for shapes and dtypes: one with nothing in it, since tracing the
    generator takes half a second."""
    return jax.tree.map(lambda x: jnp.asarray(x)[None], empty_level(config.env.capacity))


# Folded into the key of the seed, then whatever varies within a stream.
INIT, LEVELS, PLAY, SHUFFLE, CURATE, TEACHER, ANTAGONIST, PROBE = range(8)


def stream(seed: int, number: int) -> Array:
    """A typed key; streams of one seed are independent."""
    return prng.fold_in(prng.key(seed), number)


def nested(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Nested dictionaries from names with slashes: parameters of a flax module."""
    tree: dict[str, Any] = {}
    for name, array in arrays.items():
        *path, last = name.split("/")
        node = tree
        for part in path:
            node = node.setdefault(part, {})
        node[last] = array
    return tree
