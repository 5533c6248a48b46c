"""What a checkpoint holds of a run: names of its parts; and a level for the shapes of what is restored."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from kinetix_dist.config import TrainConfig
from kinetix_dist.level.level import Level
from kinetix_dist.level.walls import empty_level

LEARNER = "learner"  # parameters, optimiser, counters
START = "start"  # in place of a checkpoint: what a new run takes of an earlier one, by the names below
PARAMS, OPTIMIZER = "params", "opt_state"  # of a `LearnerState`
CURRICULUM = "curriculum"  # its state
ACTING = "acting"  # split placement: parameters that play the batch in flight
PROPOSING = "proposing"  # split placement, curricula that observe: the state that proposed the batch in flight


def one_level(config: TrainConfig) -> Level:
    """A level in arrays of the run, [1, ...], for shapes and dtypes: one with nothing in it, since tracing the
    generator takes half a second."""
    return jax.tree.map(lambda x: jnp.asarray(x)[None], empty_level(config.env.capacity))
