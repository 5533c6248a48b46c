"""What a rollout process of the split placement holds: a part of the worlds, and no state between calls."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from kinetix_dist.config import TrainConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import replicate
from kinetix_dist.runtime.cores.copies import Copies
from kinetix_dist.runtime.cores.playing import Playing
from kinetix_dist.runtime.cores.rollout_core import Batch


class RolloutWorker:
    """Part `index` of the worlds: one rollout actor of the split placement. Stateless between calls but for programs of
    the phase it is in."""

    def __init__(self, config: TrainConfig, mesh: Mesh, *, index: int, num_parts: int) -> None:
        self._mesh = mesh
        self._schedule = config.schedule
        self._groups = config.groups_of_part(index, num_parts)
        self._playing = Playing(config, mesh, groups=self._groups)
        self._playing.rollout(config)  # what cannot be divided or loaded is found before anything is asked for

    def play(
        self, update: int, policy_version: int, params: Any, state: Any
    ) -> tuple[dict[str, Any], tuple[Batch, Any]]:
        """(stamp, (batch, what the curriculum observes of it or None) as numpy) of this part of batch `update`.

        state: of the curriculum.
        """
        began, copies = time.monotonic(), Copies()
        config = self._schedule.at(update).config
        rollout = self._playing.rollout(config)
        with copies.timed("weights_to_device") as copied:
            params, state = replicate(params, self._mesh), replicate(state, self._mesh)
            copied += jax.block_until_ready([params, state])
        played = jax.block_until_ready(rollout.play(params, state, update))
        with copies.timed("device_to_host") as copied:
            batch, seen, sums = jax.device_get(played)
            copied += [batch, seen]
        content = _each_world_once(rollout.division, batch, seen)
        stamp = {
            "update": update,
            "policy_version": policy_version,
            "num_env_steps": len(self._groups) * config.rollout.steps_per_group,
            "sums": sums,
            "copies": copies.found,
            "seconds": time.monotonic() - began,
        }
        return stamp, content


def _each_world_once(division: Division, batch: Batch, seen: Any) -> tuple[Batch, Any]:
    if division.is_even:
        return batch, seen

    def once(x: Any, axis: int = 0) -> Any:
        return np.take(x, division.gathered(x.shape[axis]), axis=axis)

    static, seen = jax.tree.map(once, (batch.static, seen))
    trajectory = jax.tree.map(lambda x: once(x, axis=1), batch.trajectory)
    return Batch(static, trajectory, once(batch.last_value)), seen
