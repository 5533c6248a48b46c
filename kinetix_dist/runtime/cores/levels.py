"""Environment of a run."""

from __future__ import annotations

import functools

from kinetix_dist.config import TrainConfig
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment


def make_environment(config: TrainConfig) -> Environment:
    """The environment of a run."""
    return _environment(config.env)


@functools.cache
def _environment(config: EnvConfig) -> Environment:
    """One for all parts of a process: each uses what another has compiled."""
    return Environment(config)
