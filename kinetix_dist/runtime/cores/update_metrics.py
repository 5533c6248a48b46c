"""Metrics of one update, by the names of `telemetry.names`, from the sums of a rollout and from the learner."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from kinetix_dist.level.level import SIZES
from kinetix_dist.runtime.cores.rollout_core import SIZES_PLAYED


def training_metrics(
    sums: Mapping[str, Any], learner_metrics: Mapping[str, Any], *, frame_skip: int
) -> dict[str, float]:
    """Metrics of one update, by the names of `telemetry.names`. frame_skip: physics steps in an environment step."""
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
    if SIZES_PLAYED in sums:
        metrics |= _by_size(sums[SIZES_PLAYED])
    million_physics_steps = float(sums["steps"]) * frame_skip / 1e6
    counts = {name: float(count) for name, count in dataclasses.asdict(sums["physics"]).items()}
    metrics |= {f"physics/{name}": count / million_physics_steps for name, count in counts.items()}
    metrics["physics/unstable_worlds"] = counts["unstable"]
    return metrics | {f"learner/{name}": float(value) for name, value in learner_metrics.items()}


def _by_size(played: Mapping[str, Any]) -> dict[str, float]:
    worlds, finished, solved = (np.asarray(played[name], np.float64) for name in ("worlds", "finished", "solved"))
    rate = np.divide(solved, finished, out=np.full(len(SIZES), np.nan), where=finished > 0)
    metrics = {f"train/solve_rate_{size}": float(rate[number]) for number, size in enumerate(SIZES)}
    shares = worlds / worlds.sum()
    return metrics | {f"train/level_share_{size}": float(shares[number]) for number, size in enumerate(SIZES)}
