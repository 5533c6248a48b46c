"""The levels a curator recommends, with what was known about each when it was scored."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.curator.scores import learnability, solve_rate
from kinetix_dist.level.level import Level


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


def keep_best(
    levels: Level, num_solved: Array, num_finished: Array, *, size: int, policy_version: Array | int
) -> LevelBuffer:
    """The `size` candidates of highest learnability; ties prefer the higher solve rate, then the lower number.

    The order is total, so it does not depend on how scoring was split over batches or devices.
    """
    num_candidates = num_solved.shape[0]
    if size > num_candidates:
        raise ValueError(f"a buffer of {size} levels cannot be filled from {num_candidates} candidates")
    score = learnability(num_solved, num_finished).astype(jnp.float32)
    candidate = jnp.arange(num_candidates, dtype=jnp.int32)
    best = jnp.lexsort((candidate, -solve_rate(num_solved, num_finished), -score))[:size]
    return LevelBuffer(
        levels=jax.tree.map(lambda x: x[best], levels),
        candidate=candidate[best],
        score=score[best],
        num_solved=num_solved[best].astype(jnp.int32),
        num_finished=num_finished[best].astype(jnp.int32),
        policy_version=jnp.asarray(policy_version, jnp.int32),
        mean_candidate_score=score.mean(),
        learnable_share=(score > 0).mean(dtype=jnp.float32),
    )


def draw(key: Array, buffer: LevelBuffer, num_levels: int) -> Level:
    """`num_levels` levels of the buffer, uniformly with replacement."""
    index = jax.random.randint(key, (num_levels,), 0, buffer.score.shape[0])
    return jax.tree.map(lambda x: x[index], buffer.levels)


def buffer_metrics(buffer: LevelBuffer, num_updates: int) -> dict[str, Any]:
    """What `telemetry.names` calls curriculum/*, of a buffer in use after `num_updates` updates."""
    return {
        "curriculum/learnability": buffer.score.mean(),
        "curriculum/solve_rate": solve_rate(buffer.num_solved, buffer.num_finished).mean(),
        "curriculum/learnable_share": buffer.learnable_share,
        "curriculum/mean_candidate_score": buffer.mean_candidate_score,
        "curriculum/buffer_age": num_updates - buffer.policy_version,
    }
