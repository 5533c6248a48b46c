"""What a checkpoint holds of a run: names of its parts; and a level for the shapes of what is restored."""

from __future__ import annotations

import jax

from kinetix_dist.config import TrainConfig
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.level import Level

LEARNER = "learner"  # parameters, optimiser, counters
START = "start"  # in place of a checkpoint: parameters of a policy that a new run starts from
CURRICULUM = "curriculum"  # its state
ACTING = "acting"  # split placement: parameters that play the batch in flight
PROPOSING = "proposing"  # split placement, curricula that observe: the state that proposed the batch in flight


def one_level(config: TrainConfig) -> Level:
    """Any level of the run, [1, ...]: for shapes and dtypes."""
    level = generate_level(jax.random.key(0), config.env.capacity, config.curriculum.generator)
    return jax.tree.map(lambda x: x[None], level)
