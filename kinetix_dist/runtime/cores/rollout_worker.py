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
from kinetix_dist.runtime.cores.copies import Copies
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.levels import make_environment
from kinetix_dist.runtime.cores.rollout_core import Batch, RolloutCore


class RolloutWorker:
    """Part `index` of the worlds: one rollout actor of the split placement. Stateless between calls."""

    def __init__(self, config: TrainConfig, mesh: Mesh, *, index: int, num_parts: int) -> None:
        self._mesh = mesh
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_distribution.head_sizes)
        curriculum = make_curriculum(config, env, policy, mesh)
        groups = config.groups_of_part(index, num_parts)
        self._num_env_steps = len(groups) * config.rollout.steps_per_group
        self._rollout = RolloutCore(config, env, policy, curriculum, mesh, groups=groups)

    def play(
        self, update: int, policy_version: int, params: Any, state: Any
    ) -> tuple[dict[str, Any], tuple[Batch, Any]]:
        """(stamp, (batch, what the curriculum observes of it or None) as numpy) of this part of batch `update`.

        state: of the curriculum.
        """
        began, copies = time.monotonic(), Copies()
        with copies.timed("weights_to_device") as copied:
            params, state = replicate(params, self._mesh), replicate(state, self._mesh)
            copied += jax.block_until_ready([params, state])
        played = jax.block_until_ready(self._rollout.play(params, state, update))
        with copies.timed("device_to_host") as copied:
            batch, seen, sums = jax.device_get(played)
            copied += [batch, seen]
        content = self._each_world_once(batch, seen)
        stamp = {
            "update": update,
            "policy_version": policy_version,
            "num_env_steps": self._num_env_steps,
            "sums": sums,
            "copies": copies.found,
            "seconds": time.monotonic() - began,
        }
        return stamp, content

    def _each_world_once(self, batch: Batch, seen: Any) -> tuple[Batch, Any]:
        if self._rollout.division.is_even:
            return batch, seen

        def once(x: Any, axis: int = 0) -> Any:
            return np.take(x, self._rollout.division.gathered(x.shape[axis]), axis=axis)

        static, seen = jax.tree.map(once, (batch.static, seen))
        trajectory = jax.tree.map(lambda x: once(x, axis=1), batch.trajectory)
        return Batch(static, trajectory, once(batch.last_value)), seen
