"""What a rollout process of the split placement holds: a part of the worlds, and no state between calls."""

from __future__ import annotations

import time
from typing import Any

import jax
from jax.sharding import Mesh

from kinetix_dist.config import TrainConfig
from kinetix_dist.learner.sharding import replicate
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.curriculum_state import make_curriculum
from kinetix_dist.runtime.cores.levels import make_environment
from kinetix_dist.runtime.cores.rollout_core import RolloutCore


class RolloutWorker:
    """Part `index` of the worlds: one rollout actor of the split placement. Stateless between calls."""

    def __init__(self, config: TrainConfig, mesh: Mesh, *, index: int, num_parts: int) -> None:
        self._mesh = mesh
        self._num_env_steps = config.rollout.steps_per_update // num_parts
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_distribution.head_sizes)
        curriculum = make_curriculum(config, env, policy)
        num_groups = config.rollout.num_groups // num_parts
        groups = range(index * num_groups, (index + 1) * num_groups)
        self._rollout = RolloutCore(config, env, policy, curriculum, mesh, groups=groups)

    def play(self, update: int, policy_version: int, params: Any, state: Any) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """(stamp, what `RolloutCore.play` gives as numpy) of this part of batch `update`. state: of the curriculum."""
        began = time.monotonic()
        params, state = replicate(params, self._mesh), replicate(state, self._mesh)
        played = jax.device_get(self._rollout.play(params, state, update))
        stamp = {
            "update": update,
            "policy_version": policy_version,
            "num_env_steps": self._num_env_steps,
            "seconds": time.monotonic() - began,
        }
        return stamp, played
