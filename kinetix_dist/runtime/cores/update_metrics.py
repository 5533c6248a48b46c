"""Metrics of one update, by the names of `telemetry.names`, from the sums of a rollout and from the learner.

Rates are of attempts, the first episodes of worlds (`actors/outcomes.py`): where worlds go on from update to update,
only the last one before a reset has them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from kinetix_dist.curator.fresh_pairs import pair_learnability
from kinetix_dist.curator.scores import learnability_now
from kinetix_dist.level.level import SIZES
from kinetix_dist.runtime.cores.rollout_sums import BY_SOURCE, FRESH_PAIRS, SIZES_PLAYED

BUFFER = "buffer"  # the source of levels that are counted one by one, slot by slot


def training_metrics(
    sums: Mapping[str, Any], learner_metrics: Mapping[str, Any], *, frame_skip: int, sources: Sequence[str]
) -> dict[str, float]:
    """Metrics of one update, by the names of `telemetry.names`. frame_skip: physics steps in an environment step;
    sources: of the curriculum."""
    attempts = float(sums["attempts"])
    metrics = {
        "train/episodes": float(sums["finished"]),
        "train/attempts": attempts,
        "train/mean_reward": float(sums["reward"]) / float(sums["steps"]),
    }
    if attempts:  # none where worlds go on into the next update
        metrics |= {
            "train/solve_rate": float(sums["solved"]) / attempts,
            "train/failed_rate": float(sums["failed"]) / attempts,
            "train/mean_return": float(sums["return"]) / attempts,
        }
        metrics |= _by_source(sums[BY_SOURCE], sources) | _learnabilities(sums[BY_SOURCE], sources)
        if SIZES_PLAYED in sums:
            metrics |= _by_size(sums[SIZES_PLAYED])
    million_physics_steps = float(sums["steps"]) * frame_skip / 1e6
    counts = {name: float(count) for name, count in dataclasses.asdict(sums["physics"]).items()}
    metrics |= {f"physics/{name}": count / million_physics_steps for name, count in counts.items()}
    metrics["physics/unstable_worlds"] = counts["unstable"]
    return metrics | {f"learner/{name}": float(value) for name, value in learner_metrics.items()}


def _by_source(played: Mapping[str, Any], sources: Sequence[str]) -> dict[str, float]:
    """Solve rates by where levels come from; nothing where all come from one source."""
    solved, attempts = (_with_slots_summed(played[name], len(sources)) for name in ("solved", "attempts"))
    names = [*sources, BUFFER][: len(attempts)]
    if len(names) < 2:
        return {}
    return {f"train/solve_rate_of_{name}": rate for name, rate in zip(names, _rates(solved, attempts), strict=True)}


def _learnabilities(played: Mapping[str, Any], sources: Sequence[str]) -> dict[str, float]:
    """Learnability of what was played, without bias: of fresh levels from pairs of worlds, of a buffer from levels that
    several worlds played."""
    metrics = {}
    if FRESH_PAIRS in played:
        metrics["curriculum/fresh_learnability"] = pair_learnability(np.asarray(played[FRESH_PAIRS]))
    solved, attempts = (np.asarray(played[name])[len(sources) :] for name in ("solved", "attempts"))
    if sources and attempts.size:  # slots of a buffer; without sources those of a level set
        now, error = learnability_now(solved, attempts)
        metrics |= {"curriculum/learnability_now": float(now), "curriculum/learnability_now_error": float(error)}
    return metrics


def _with_slots_summed(counts: Any, num_sources: int) -> np.ndarray:
    """[sources], and one more where there are slots of a buffer."""
    counts = np.asarray(counts, np.float64)
    slots = counts[num_sources:]
    return np.append(counts[:num_sources], slots.sum()) if slots.size else counts


def _by_size(played: Mapping[str, Any]) -> dict[str, float]:
    solved, attempts = (np.asarray(played[name], np.float64) for name in ("solved", "attempts"))
    rates, shares = _rates(solved, attempts), (attempts / attempts.sum()).tolist()
    metrics = {f"train/solve_rate_{size}": rate for size, rate in zip(SIZES, rates, strict=True)}
    return metrics | {f"train/level_share_{size}": share for size, share in zip(SIZES, shares, strict=True)}


def _rates(solved: np.ndarray, attempts: np.ndarray) -> list[float]:
    """Solved / attempts, nan without any."""
    return np.divide(solved, attempts, out=np.full(len(attempts), np.nan), where=attempts > 0).tolist()
