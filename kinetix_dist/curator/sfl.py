"""Sampling For Learnability: score random levels with the current policy, keep those it solves sometimes.

Every `refresh_every` updates: N fresh candidates, `scoring_steps` environment steps of the policy on each, score
p(1-p), keep the best K. A share of the worlds plays levels of this buffer, the rest fresh ones. What is kept depends on
the key and the parameters alone. Candidates are scored in batches of `scoring_batch`, each with a key of its own, and
batches in turn on the devices of the process: the buffer is the same to the bit however many these are.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.curator.buffer_share import by_group, join_by_group, num_from_buffer
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.curator.level_buffer import LevelBuffer, buffer_metrics, draw, keep_best
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.level import Level


class Sfl(Curriculum):
    """Its state is the `LevelBuffer`. Each of the two programs of a refresh is compiled once."""

    refreshes = True

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        self._score_batch = jax.jit(self._score)
        self._keep_best = jax.jit(self._keep)

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        num_from_buffer(config, worlds_per_group)

    def init(self) -> LevelBuffer:
        config = self.tools.config
        level = generate_level(jax.random.key(0), self.tools.capacity, config.generator)
        levels = jax.tree.map(lambda x: jnp.broadcast_to(x, (config.buffer_size, *jnp.shape(x))), level)
        count = jnp.zeros(config.buffer_size, jnp.int32)
        return keep_best(levels, count, count, size=config.buffer_size, policy_version=0)

    def propose(self, state: LevelBuffer | None, group_keys: Array, groups: Array) -> Proposal:
        """A group's worlds are those of the buffer first, then the fresh ones."""
        del groups
        if state is None:
            raise ValueError("a curriculum with a buffer was asked for levels before it was filled")
        size, num_groups = self.tools.worlds_per_group, group_keys.shape[0]
        num_buffered = num_from_buffer(self.tools.config, size)
        num_fresh = size - num_buffered
        split = jax.vmap(jax.random.split)(group_keys)
        parts = []
        if num_buffered:
            parts.append(jax.vmap(lambda key: draw(key, state, num_buffered))(split[:, 0]))
        if num_fresh:
            parts.append(by_group(self.tools.draw_fresh(split[:, 1], num_fresh), num_groups))
        return Proposal(levels=join_by_group(*parts))

    def refresh(self, params: Any, policy_version: int, key: Array) -> LevelBuffer:
        """A new buffer of candidates scored by `params`; the whole previous one is replaced."""
        config = self.tools.config
        num_batches = config.num_candidates // config.scoring_batch
        devices = self.tools.devices[:num_batches]
        placed = [jax.device_put((params, key), device) for device in devices]

        def score(index: int) -> Any:
            params, key = placed[index % len(devices)]
            return self._score_batch(params, jax.random.fold_in(key, index))

        parts = [score(index) for index in range(num_batches)]  # asked of all devices before any is waited for
        return self._keep_best(jax.device_put(parts, devices[0]), jnp.int32(policy_version))

    def metrics(self, state: LevelBuffer | None, num_updates: int) -> dict[str, Any]:
        return {} if state is None else buffer_metrics(state, num_updates)

    def _score(self, params: Any, key: Array) -> tuple[Level, Array, Array]:
        level_key, play_key = jax.random.split(key)
        levels = self.tools.draw_fresh(level_key[None], self.tools.config.scoring_batch)
        outcome = self.tools.play(params, levels, play_key, self.tools.config.scoring_steps)
        return levels, outcome.num_solved, outcome.num_finished

    def _keep(self, parts: list[tuple[Level, Array, Array]], policy_version: Array) -> LevelBuffer:
        levels, num_solved, num_finished = jax.tree.map(lambda *xs: jnp.concatenate(xs), *parts)
        size = self.tools.config.buffer_size
        return keep_best(levels, num_solved, num_finished, size=size, policy_version=policy_version)
