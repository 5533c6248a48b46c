"""What a rollout process of the split placement holds: a part of the worlds, and no state between calls."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from kinetix_dist.config import TrainConfig
from kinetix_dist.learner.sharding import replicate
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.levels import make_environment
from kinetix_dist.runtime.cores.rollout_core import Batch, RolloutCore


class RolloutWorker:
    """Part `index` of the worlds: one rollout actor of the split placement. Stateless between calls."""

    def __init__(self, config: TrainConfig, mesh: Mesh, *, index: int, num_parts: int) -> None:
        self._mesh = mesh
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_distribution.head_sizes)
        curriculum = make_curriculum(config, env, policy)
        groups = config.groups_of_part(index, num_parts)
        self._num_env_steps = len(groups) * config.rollout.steps_per_group
        self._rollout = RolloutCore(config, env, policy, curriculum, mesh, groups=groups)

    def play(self, update: int, policy_version: int, params: Any, state: Any) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """(stamp, what `RolloutCore.play` gives as numpy) of this part of batch `update`. state: of the curriculum."""
        began = time.monotonic()
        params, state = replicate(params, self._mesh), replicate(state, self._mesh)
        played = self._each_world_once(*jax.device_get(self._rollout.play(params, state, update)))
        stamp = {
            "update": update,
            "policy_version": policy_version,
            "num_env_steps": self._num_env_steps,
            "seconds": time.monotonic() - began,
        }
        return stamp, played

    def _each_world_once(self, batch: Batch, seen: Any, sums: Any) -> tuple[Any, ...]:
        if self._rollout.division.is_even:
            return batch, seen, sums

        def once(x: Any, axis: int = 0) -> Any:
            return np.take(x, self._rollout.division.gathered(x.shape[axis]), axis=axis)

        static_obs, seen = jax.tree.map(once, (batch.static_obs, seen))
        trajectory = jax.tree.map(lambda x: once(x, axis=1), batch.trajectory)
        return Batch(static_obs, trajectory, once(batch.last_value)), seen, sums
