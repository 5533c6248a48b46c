"""Scoring fresh levels: a buffer of learnable ones, from parameters and a key. Plain JAX on one device."""

from __future__ import annotations

import time
from typing import Any

import jax

from jax2d.scene import Array
from kinetix_dist.actors.unroll import score
from kinetix_dist.config import TrainConfig
from kinetix_dist.curator.domain_randomization import fresh_levels
from kinetix_dist.curator.level_buffer import LevelBuffer
from kinetix_dist.curator.sfl import SflScorer
from kinetix_dist.env.noop import noop_solved
from kinetix_dist.level.level import Level
from kinetix_dist.models.policy import make_policy
from kinetix_dist.runtime.cores.levels import make_environment
from kinetix_dist.runtime.cores.streams import CURATE, stream


class CuratorCore:
    """Scores fresh levels with given parameters. The same (parameters, version) give the same buffer, bit for bit."""

    def __init__(self, config: TrainConfig) -> None:
        curriculum = config.curriculum
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_head_sizes)

        def draw_levels(key: Array, num_levels: int) -> Level:
            return fresh_levels(
                key[None],
                num_levels,
                capacity=env.capacity,
                generator=curriculum.generator,
                noop_solved=lambda levels: noop_solved(env, levels),
            )

        def play(params: Any, levels: Level, key: Array) -> tuple[Array, Array]:
            outcome = score(policy, params, env, env.prepare(levels), key, curriculum.scoring_steps)
            return outcome.num_solved, outcome.num_finished

        self._seed = config.run.seed
        self._scorer = SflScorer(
            num_candidates=curriculum.num_candidates,
            batch=curriculum.scoring_batch,
            buffer_size=curriculum.buffer_size,
            draw_levels=draw_levels,
            play=play,
        )

    def refresh(self, params: Any, policy_version: int) -> tuple[dict[str, float], LevelBuffer]:
        """({"seconds": how long it took}, a new buffer as numpy)."""
        began = time.monotonic()
        key = jax.random.fold_in(stream(self._seed, CURATE), policy_version)
        buffer = jax.device_get(self._scorer.refresh(jax.device_put(params), policy_version, key))
        return {"seconds": time.monotonic() - began}, buffer
