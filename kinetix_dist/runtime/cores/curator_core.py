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
from kinetix_dist.runtime.cores.streams import CURATE, PROBE, stream


class CuratorCore:
    """Refreshes with given parameters. The same (parameters, version) give the same answer, bit for bit."""

    def __init__(self, config: TrainConfig) -> None:
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_distribution.head_sizes)
        self._seed = config.run.seed
        self._curriculum = make_curriculum(config, env, policy, data_mesh())

    def refresh(
        self, params: Any, policy_version: int, part: int, num_parts: int, probe: Any = None
    ) -> tuple[dict[str, Any], Any]:
        """({"seconds": how long it took, "probe": what became of `probe`}, this part of what the curriculum joins and
        adopts, as numpy). probe: levels of the buffer in use, played again with a key of their own; None: no such."""
        began = time.monotonic()
        params = jax.device_put(params)
        key = jax.random.fold_in(stream(self._seed, CURATE), policy_version)
        refreshed = self._curriculum.refresh_part(params, policy_version, key, part, num_parts)
        refreshed = jax.device_get(refreshed)
        played = {}
        if probe is not None:
            probe_key = jax.random.fold_in(stream(self._seed, PROBE), policy_version)
            played = self._curriculum.play_probe(params, probe, probe_key)
        return {"seconds": time.monotonic() - began, "probe": played}, refreshed
