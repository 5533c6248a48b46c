"""What a curator holds: a curriculum that refreshes, from parameters and a key. Plain JAX on the devices it has."""

from __future__ import annotations

import time
from typing import Any

import jax

from kinetix_dist.config import TrainConfig
from kinetix_dist.learner.sharding import data_mesh
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.levels import make_environment
from kinetix_dist.runtime.cores.streams import CURATE, stream


class CuratorCore:
    """Refreshes with given parameters. The same (parameters, version) give the same answer, bit for bit."""

    def __init__(self, config: TrainConfig) -> None:
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_distribution.head_sizes)
        self._seed = config.run.seed
        self._curriculum = make_curriculum(config, env, policy, data_mesh())

    def refresh(self, params: Any, policy_version: int, part: int, num_parts: int) -> tuple[dict[str, float], Any]:
        """({"seconds": how long it took}, this part of what the curriculum joins and adopts, as numpy)."""
        began = time.monotonic()
        key = jax.random.fold_in(stream(self._seed, CURATE), policy_version)
        refreshed = self._curriculum.refresh_part(jax.device_put(params), policy_version, key, part, num_parts)
        refreshed = jax.device_get(refreshed)
        return {"seconds": time.monotonic() - began}, refreshed
