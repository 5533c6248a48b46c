"""Metrics of one update, by the names of `telemetry.names`, from the sums of a rollout and from the learner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


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
