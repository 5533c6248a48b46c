"""What a new run starts from: its seed, or the parameters of a policy that exists (`run.start_from`).

Optimiser, counters, curriculum and random streams are those of a new run.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from kinetix_dist.checkpoint import CheckpointError, flatten_arrays, load_checkpoint
from kinetix_dist.config import TrainConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.load_policy import load_policy
from kinetix_dist.runtime.cores.stored import START, one_level


def starting_arrays(config: TrainConfig) -> dict[str, np.ndarray] | None:
    """What `Trainer.start` takes at update 0; None: all from the seed.

    Raises CheckpointError where there is no such checkpoint, or, naming an array, one of another network.
    """
    if not config.run.start_from:
        return None
    checkpoint = load_checkpoint(Path(config.run.start_from))
    env = Environment(dataclasses.replace(config.env, effect_groups=0))  # for shapes
    try:
        _, params = load_policy(checkpoint, config.policy, env, one_level(config))
    except ValueError as error:
        raise CheckpointError(
            f"run.start_from: {checkpoint.path} does not fit policy.*, env.observation and env.action_space of this "
            f"run: {error}"
        ) from error
    return flatten_arrays({START: params})
