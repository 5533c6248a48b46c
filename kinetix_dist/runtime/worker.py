"""What a process holds: cores, and what the controller asks of them. No Ray here: local mode uses these classes too.

Worker          worlds and a learner shard      colocated placement, and all of local mode
LearnerWorker   the learner alone               split placement
RolloutWorker   a part of the worlds            split placement
CuratorCore     (cores.py)                      both
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from kinetix_dist.checkpoint import flatten_arrays
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.level_buffer import LevelBuffer, buffer_metrics
from kinetix_dist.learner.sharding import data_mesh, local_values, replicate, shard_worlds
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.compile_cache import compile_seconds, enable_compile_cache
from kinetix_dist.runtime.cores import BUFFER, LEARNER, CuratorCore, LearnerCore, RolloutCore, stored_buffer
from kinetix_dist.runtime.evaluator import Evaluator
from kinetix_dist.runtime.levels import make_environment
from kinetix_dist.runtime.placement import ProcessPlan


class LearnerWorker:
    """Parameters, optimiser, evaluation; learns from batches that are handed in as numpy."""

    def __init__(self, config: TrainConfig, mesh: Mesh) -> None:
        self._config = config
        self._mesh = mesh
        self._env = make_environment(config)
        self._policy = make_policy(config.policy, self._env.action_head_sizes)
        self._learner = LearnerCore(config, self._env, self._policy, mesh)
        self._evaluator = Evaluator(config, self._env, self._policy)
        self._buffer: LevelBuffer | None = None  # numpy

    def start(self, arrays: Mapping[str, np.ndarray] | None) -> LevelBuffer | None:
        """From a checkpoint's arrays or afresh; returns the buffer in use, which rollout actors draw from."""
        self._learner.start(arrays)
        self._buffer = None
        if (buffer := stored_buffer(self._config, arrays)) is not None:
            self.adopt(buffer)
        return self._buffer

    def weights(self) -> Any:
        return local_values(self._learner.params)

    def adopt(self, buffer: LevelBuffer) -> None:
        self._buffer = jax.device_get(buffer)

    def learn(self, num_updates: int, *parts: tuple[Any, ...]) -> tuple[dict[str, float], dict[str, float]]:
        """Learns from the parts of a batch, in the order of their worlds: (metrics, seconds)."""
        began = time.monotonic()
        static_obs, trajectory, last_value, sums = zip(*parts, strict=True)
        metrics = self._learner.learn(
            shard_worlds(jax.tree.map(lambda *xs: np.concatenate(xs), *static_obs), self._mesh),
            shard_worlds(jax.tree.map(lambda *xs: np.concatenate(xs, axis=1), *trajectory), self._mesh, axis=1),
            shard_worlds(np.concatenate(last_value), self._mesh),
        )
        metrics = self._metrics(num_updates, jax.tree.map(lambda *xs: sum(xs), *sums), local_values(metrics))
        return metrics, {"learn": time.monotonic() - began}

    def snapshot(self) -> dict[str, np.ndarray]:
        """Arrays of a checkpoint."""
        state: dict[str, Any] = {LEARNER: local_values(self._learner.state)}
        if self._buffer is not None:
            state[BUFFER] = self._buffer
        return flatten_arrays(state)

    def evaluate(self, use_policy: bool) -> dict[str, dict[str, float]]:
        return self._evaluator.evaluate(self.weights() if use_policy else None)

    def record(self, num_rollouts: int, num_updates: int) -> list[Any]:
        return self._evaluator.record(self.weights(), num_rollouts, num_updates)

    def facts(self) -> dict[str, Any]:
        """What a report says of this process."""
        device = self._mesh.devices.flat[0]
        devices = {"platform": device.platform, "kind": device.device_kind, "count": int(self._mesh.devices.size)}
        return {"device": devices, "compile_seconds": round(compile_seconds(), 1)}

    def _metrics(
        self, num_updates: int, sums: Mapping[str, Any], learner_metrics: Mapping[str, Any]
    ) -> dict[str, float]:
        metrics = training_metrics(sums, learner_metrics)
        if self._buffer is not None:
            metrics |= {name: float(np.asarray(x)) for name, x in buffer_metrics(self._buffer, num_updates).items()}
        return metrics


class Worker(LearnerWorker):
    """Worlds on the devices of a learner shard: batches never leave them."""

    def __init__(self, config: TrainConfig, mesh: Mesh) -> None:
        super().__init__(config, mesh)
        self._rollout = RolloutCore(
            config, self._env, self._policy, mesh, first_group=0, num_groups=config.rollout.num_groups
        )
        self._placed_buffer: LevelBuffer | None = None  # on the devices

    def adopt(self, buffer: LevelBuffer) -> None:
        super().adopt(buffer)
        self._placed_buffer = replicate(self._buffer, self._mesh)

    def run_update(self, num_updates: int) -> tuple[dict[str, float], dict[str, float]]:
        """(metrics, seconds of "rollout" and "learn")."""
        began = time.monotonic()
        *batch, sums = self._rollout.play(self._learner.params, self._placed_buffer, num_updates)
        sums = local_values(sums)  # waits for the rollout
        played = time.monotonic()
        learner_metrics = local_values(self._learner.learn(*batch))
        learned = time.monotonic()
        metrics = self._metrics(num_updates, sums, learner_metrics)
        return metrics, {"rollout": played - began, "learn": learned - played}


class RolloutWorker:
    """Part `index` of the worlds: one rollout actor of the split placement. Stateless between calls."""

    def __init__(self, config: TrainConfig, mesh: Mesh, *, index: int, num_parts: int) -> None:
        self._mesh = mesh
        self._num_env_steps = config.rollout.steps_per_update // num_parts
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_head_sizes)
        num_groups = config.rollout.num_groups // num_parts
        self._rollout = RolloutCore(config, env, policy, mesh, first_group=index * num_groups, num_groups=num_groups)

    def play(
        self, update: int, policy_version: int, params: Any, buffer: LevelBuffer | None
    ) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """(stamp, batch as numpy) of this part of batch `update`."""
        began = time.monotonic()
        params, buffer = replicate(params, self._mesh), replicate(buffer, self._mesh)
        batch = jax.device_get(self._rollout.play(params, buffer, update))
        stamp = {
            "update": update,
            "policy_version": policy_version,
            "num_env_steps": self._num_env_steps,
            "seconds": time.monotonic() - began,
        }
        return stamp, batch


# What a backend spawns


def build_worker(plan: ProcessPlan, num_processes: int, config: TrainConfig) -> Worker:
    del plan, num_processes
    enable_compile_cache(config.run.compile_cache)
    return Worker(config, data_mesh())


def build_learner(plan: ProcessPlan, num_processes: int, config: TrainConfig) -> LearnerWorker:
    del plan, num_processes
    enable_compile_cache(config.run.compile_cache)
    return LearnerWorker(config, data_mesh())


def build_rollout(plan: ProcessPlan, num_processes: int, config: TrainConfig) -> RolloutWorker:
    del num_processes
    enable_compile_cache(config.run.compile_cache)
    return RolloutWorker(config, data_mesh(), index=plan.index, num_parts=config.run.num_rollout_actors)


def build_curator(plan: ProcessPlan, num_processes: int, config: TrainConfig) -> CuratorCore:
    del plan, num_processes
    enable_compile_cache(config.run.compile_cache)
    return CuratorCore(config)


def training_metrics(sums: Mapping[str, Any], learner_metrics: Mapping[str, Any]) -> dict[str, float]:
    """Metrics of one update, by the names of `telemetry.names`."""
    finished = float(sums["finished"])

    def per_episode(name: str) -> float:
        return float(sums[name]) / finished if finished else float("nan")

    metrics = {
        "train/episodes": finished,
        "train/solve_rate": per_episode("solved"),
        "train/failed_rate": per_episode("failed"),
        "train/mean_return": per_episode("return"),
        "train/mean_reward": float(sums["reward"]) / float(sums["steps"]),
    }
    return metrics | {f"learner/{name}": float(value) for name, value in learner_metrics.items()}
