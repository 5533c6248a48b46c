"""The levels a curator recommends, with what was known about each when it was scored."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.checkpoint import flatten_arrays
from kinetix_dist.curator.scores import exact_keys, learnability, solve_rate
from kinetix_dist.level.features import FEATURES
from kinetix_dist.level.level import Level
from kinetix_dist.telemetry.curriculum_log import LEVELS


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelBuffer:
    """`K` levels, best first, all scored by one version of the policy."""

    levels: Level  # [K, ...]
    candidate: Array  # [K] int32, number of the level among the candidates of its refresh
    score: Array  # [K] float32
    num_solved: Array  # [K] int32, episodes solved while scoring
    num_finished: Array  # [K] int32, episodes finished while scoring
    policy_version: Array  # [] int32, that scored them
    mean_candidate_score: Array  # [] float32, over all candidates, kept or not
    learnable_share: Array  # [] float32, candidates with a score above zero / all candidates


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Scored:
    """Candidates of a refresh that one process scored: counts of all, levels of the best."""

    candidate: Array  # [n] int32, number of each among the candidates of the refresh
    num_solved: Array  # [n] int32
    num_finished: Array  # [n] int32
    features: Array  # [n, F] uint8, `level_features` of all of them
    best: Array  # [k] int32, the numbers of its best ones, best first
    levels: Level  # [k, ...] of these
    policy_version: Array  # [] int32, that scored them


class Candidates(NamedTuple):
    """Candidates that were played, as numpy."""

    number: np.ndarray  # [n] among the candidates of the refresh
    num_solved: np.ndarray  # [n]
    num_finished: np.ndarray  # [n]
    features: np.ndarray  # [n, F] uint8


def scored(
    candidates: Candidates,
    pick: Callable[[np.ndarray], Level],
    *,
    size: int,
    policy_version: int,
    min_finished: int = 0,
) -> Scored:
    """Counts and best levels of candidates, for a buffer of `size`. pick: levels of some, by index.

    min_finished: episodes that a candidate needs to be one of the best.
    """
    number, num_solved, num_finished, features = candidates
    index = _best_first(number, num_solved, num_finished, min_finished)[:size]
    return Scored(
        candidate=np.asarray(number, np.int32),
        num_solved=np.asarray(num_solved, np.int32),
        num_finished=np.asarray(num_finished, np.int32),
        features=features,
        best=np.asarray(number, np.int32)[index],
        levels=jax.device_get(pick(index)),
        policy_version=np.int32(policy_version),
    )


def keep_best(parts: Sequence[Scored], size: int, min_finished: int = 0) -> LevelBuffer:
    """The `size` candidates of highest learnability, of those with `min_finished` episodes; ties prefer the higher
    solve rate, then the lower number.

    The order is total, of integers, and worked out on the host, so that the buffer is the same to the bit however
    candidates were shared out. Raises ValueError where there are fewer than `size`.
    """
    candidate, num_solved, num_finished, best = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in ("candidate", "num_solved", "num_finished", "best")
    )
    if size > (num_eligible := int((num_finished >= min_finished).sum())):
        raise ValueError(f"a buffer of {size} levels cannot be filled from {num_eligible} candidates")
    order = np.argsort(candidate)
    candidate, num_solved, num_finished = candidate[order], num_solved[order], num_finished[order]
    score = learnability(num_solved.astype(np.float32), num_finished.astype(np.float32))
    kept = _best_first(candidate, num_solved, num_finished, min_finished)[:size]
    slot_of = {number: slot for slot, number in enumerate(best.tolist())}  # among the levels that were sent
    slots = [slot_of[number] for number in candidate[kept].tolist()]
    return LevelBuffer(
        levels=jax.tree.map(lambda *xs: np.concatenate(xs)[slots], *(part.levels for part in parts)),
        candidate=candidate[kept],
        score=score[kept],
        num_solved=num_solved[kept],
        num_finished=num_finished[kept],
        policy_version=parts[0].policy_version,
        mean_candidate_score=np.float32(score.mean(dtype=np.float64)),
        learnable_share=np.float32((score > 0).mean()),
    )


def _best_first(
    candidate: np.ndarray, num_solved: np.ndarray, num_finished: np.ndarray, min_finished: int
) -> np.ndarray:
    learnabilities, rates = exact_keys(num_solved, num_finished)
    order = np.lexsort((candidate, -rates, -learnabilities))
    return order[num_finished[order] >= min_finished]


def draw(key: Array, buffer: LevelBuffer, num_levels: int) -> tuple[Level, Array]:
    """`num_levels` levels, uniformly with replacement, and their slots in the buffer, [num_levels]."""
    index = prng.randint(key, (num_levels,), 0, buffer.score.shape[0])
    return jax.tree.map(lambda x: x[index], buffer.levels), index


def refresh_log(parts: Sequence[Scored], size: int, min_finished: int = 0) -> dict[str, np.ndarray]:
    """Arrays of a refresh_*.npz: the levels of the buffer and counts of all candidates, see docs/run_data.md."""
    buffer = keep_best(parts, size, min_finished)
    order = np.argsort(np.concatenate([part.candidate for part in parts]))
    all_features = np.concatenate([part.features for part in parts])[order]
    counts = {
        f"candidates/{name}": np.concatenate([getattr(part, f"num_{name}") for part in parts])[order]
        for name in ("solved", "finished")
    }
    return {
        "policy_version": np.asarray(buffer.policy_version, np.int32),
        "score": buffer.score,
        "solved": buffer.num_solved,
        "finished": buffer.num_finished,
        "candidate": buffer.candidate,
        "features": all_features[buffer.candidate],
        "feature_names": np.array(FEATURES),
        **counts,
        "candidates/features": all_features,
        **{f"{LEVELS}{path}": array for path, array in flatten_arrays(buffer.levels).items()},
    }


def buffer_metrics(buffer: LevelBuffer, num_updates: int) -> dict[str, Any]:
    """Metrics curriculum/* of a buffer in use after `num_updates` updates."""
    rates = solve_rate(buffer.num_solved, buffer.num_finished)
    return {
        "curriculum/learnability": buffer.score.mean(),
        "curriculum/solve_rate": rates.mean(),
        "curriculum/learnable_share": buffer.learnable_share,
        "curriculum/mean_candidate_score": buffer.mean_candidate_score,
        "curriculum/buffer_age": num_updates - buffer.policy_version,
    }
