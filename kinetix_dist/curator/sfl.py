"""Sampling For Learnability: score random levels with the current policy, keep those it solves sometimes.

Every `refresh_every` updates: N fresh candidates, `scoring_steps` environment steps of the policy on each, score
p(1-p), keep the best K. The result depends on the key and the parameters alone; `scoring_batch` only bounds memory
(each batch has keys of its own).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.curator.level_buffer import LevelBuffer, keep_best
from kinetix_dist.level.level import Level

# (key, number of levels) -> levels; and (params, levels, key) -> episodes (solved [W], finished [W])
DrawLevels = Callable[[Array, int], Level]
PlayLevels = Callable[[Any, Level, Array], tuple[Array, Array]]


class SflScorer:
    """Scores candidates batch by batch; each of its two programs is compiled once."""

    def __init__(
        self, *, num_candidates: int, batch: int, buffer_size: int, draw_levels: DrawLevels, play: PlayLevels
    ) -> None:
        if num_candidates % batch:
            raise ValueError(
                f"num_candidates {num_candidates} is not a multiple of scoring_batch {batch}; change one of them"
            )
        self.num_batches = num_candidates // batch
        self._buffer_size = buffer_size

        def score_batch(params: Any, key: Array) -> tuple[Level, Array, Array]:
            level_key, play_key = jax.random.split(key)
            levels = draw_levels(level_key, batch)
            return levels, *play(params, levels, play_key)

        self._score_batch = jax.jit(score_batch)
        self._keep_best = jax.jit(self._keep)

    def refresh(self, params: Any, policy_version: int, key: Array) -> LevelBuffer:
        """A new buffer of candidates scored by `params`; the whole previous one is replaced."""
        parts = [self._score_batch(params, jax.random.fold_in(key, index)) for index in range(self.num_batches)]
        return self._keep_best(parts, jnp.int32(policy_version))

    def _keep(self, parts: list[tuple[Level, Array, Array]], policy_version: Array) -> LevelBuffer:
        levels, num_solved, num_finished = jax.tree.map(lambda *xs: jnp.concatenate(xs), *parts)
        return keep_best(levels, num_solved, num_finished, size=self._buffer_size, policy_version=policy_version)
