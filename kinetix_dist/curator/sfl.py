"""Sampling For Learnability: score random levels with the current policy, store those it solves sometimes.

Every `refresh_every` updates: N fresh candidates, `scoring_steps` environment steps of the policy on each, score
p(1-p), the best K make the buffer. A share of the worlds plays its levels, the rest fresh ones. The buffer depends on
the key and the parameters alone: candidates are scored in batches of `scoring_batch`, each with a key of its own;
batches go in turn to the processes that share a refresh, and there in turn to the devices.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.curator.buffer_share import by_group, join_by_group, num_from_buffer
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.curator.fresh_pairs import with_pair
from kinetix_dist.curator.level_buffer import (
    Candidates,
    LevelBuffer,
    Scored,
    buffer_metrics,
    draw,
    keep_best,
    refresh_log,
    scored,
)
from kinetix_dist.level.features import level_features
from kinetix_dist.level.level import Level
from kinetix_dist.level.size_mixture import counts_of
from kinetix_dist.level.walls import empty_level


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Probe:
    """Some levels of a buffer, to be played again."""

    policy_version: Any  # [] int32, that scored the buffer
    index: Any  # [m] int32, slots in the buffer
    levels: Level  # [m, ...]


class Sfl(Curriculum):
    """Its state is the `LevelBuffer`. Each program of a refresh is compiled once."""

    refreshes = True
    shares_refresh = True
    scores_by_steps = True
    sources = ("fresh",)

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        self._score_batch = jax.jit(self._score)
        self._pick = jax.jit(_pick)
        self._features = jax.jit(level_features)
        self._play = jax.jit(tools.play, static_argnums=3)

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        num_from_buffer(config, worlds_per_group)
        if config.buffer_size > config.num_candidates:
            raise ValueError(
                f"CurriculumConfig.buffer_size {config.buffer_size} is larger than num_candidates "
                f"{config.num_candidates}"
            )
        if config.sizes:
            counts_of(config.sizes, config.scoring_batch)

    @classmethod
    def num_fresh(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        return worlds_per_group - num_from_buffer(config, worlds_per_group)

    @property
    def num_slots(self) -> int:
        return self.tools.config.buffer_size

    def init(self) -> LevelBuffer:
        config = self.tools.config
        levels = self._empty_levels(config.buffer_size)  # the first refresh comes before the first levels
        count, number = jnp.zeros(config.buffer_size, jnp.int32), jnp.float32(0)
        return LevelBuffer(
            levels=levels,
            candidate=count,
            score=count.astype(jnp.float32),
            num_solved=count,
            num_finished=count,
            policy_version=jnp.int32(0),
            mean_candidate_score=number,
            learnable_share=number,
        )

    def propose(self, state: LevelBuffer | None, group_keys: Array, groups: Array) -> Proposal:
        """A group's worlds are those of the buffer first, then the fresh ones."""
        del groups
        if state is None:
            raise ValueError("a curriculum with a buffer cannot propose levels before it is filled")
        size, num_groups = self.tools.worlds_per_group, group_keys.shape[0]
        num_buffered = num_from_buffer(self.tools.config, size)
        num_fresh = self.num_fresh(self.tools.config, size)
        split = jax.vmap(prng.split)(group_keys)
        parts, sources, copy_of = [], [], None
        if num_buffered:
            levels, slots = jax.vmap(lambda key: draw(key, state, num_buffered))(split[:, 0])
            parts.append(levels)
            sources.append(len(self.sources) + slots)
        if num_fresh:
            drawn = by_group(self.tools.draw_fresh(split[:, 1], num_fresh), num_groups)
            levels, copy_of = with_pair(group_keys, drawn, num_buffered)
            parts.append(levels)
            sources.append(jnp.full((num_groups, num_fresh), self.sources.index("fresh"), jnp.int32))
        return Proposal(levels=join_by_group(*parts), source=join_by_group(*sources), copy_of=copy_of)

    def refresh_part(
        self, params: Any, policy_version: int, key: Array, part: int, num_parts: int, given: Any = None
    ) -> Scored:
        """Every `num_parts`-th batch of the candidates, scored by `params`."""
        del given
        config = self.tools.config
        batches = range(part, config.num_batches, num_parts)
        devices = self.tools.devices[: len(batches)]
        placed = [jax.device_put((params, key), device) for device in devices]

        def score(index: int, batch: int) -> Any:
            params, key = placed[index % len(devices)]
            return self._score_batch(params, prng.fold_in(key, batch))

        # All devices get work before any is waited for.
        levels, *counts = zip(*(score(index, batch) for index, batch in enumerate(batches)), strict=True)
        columns = (*counts, [self._features(batch) for batch in levels])
        num_solved, num_finished, features = (np.concatenate(jax.device_get(column)) for column in columns)
        one_batch = np.arange(config.scoring_batch)
        number = np.concatenate([batch * config.scoring_batch + one_batch for batch in batches])
        return scored(
            Candidates(number, num_solved, num_finished, features),
            lambda index: self._pick(jax.device_put(levels, devices[0]), index),
            size=config.buffer_size,
            policy_version=policy_version,
        )

    def join(self, parts: Sequence[Scored]) -> LevelBuffer:
        """A new buffer; the whole previous one is replaced."""
        return keep_best(parts, self.tools.config.buffer_size)

    def metrics(self, state: LevelBuffer | None, num_updates: int) -> dict[str, Any]:
        if state is None:
            return {}
        return buffer_metrics(state, num_updates)

    @classmethod
    def refresh_log(cls, config: CurriculumConfig, parts: Sequence[Scored]) -> dict[str, np.ndarray]:
        return refresh_log(parts, config.buffer_size)

    def probe(self, state: LevelBuffer | None, num_levels: int) -> Probe | None:
        """Levels of the buffer in use, evenly spread over their ranks; all where it has fewer. None before it."""
        if state is None or not num_levels:
            return None
        num_levels = min(num_levels, len(state.score))
        index = np.arange(num_levels) * len(state.score) // num_levels
        levels = jax.tree.map(lambda x: np.asarray(x)[index], state.levels)
        return Probe(policy_version=state.policy_version, index=index.astype(np.int32), levels=levels)

    def play_probe(self, params: Any, probe: Probe, key: Array) -> dict[str, np.ndarray]:
        """Outcomes of the probe's levels, played by the new policy as candidates are."""
        outcome = self._play(params, probe.levels, key, self.tools.config.scoring_steps)
        return {
            "policy_version": np.asarray(probe.policy_version, np.int32),
            "index": probe.index,
            "solved": np.asarray(outcome.num_solved),
            "finished": np.asarray(outcome.num_finished),
        }

    def compile_refresh(self, params: Any) -> None:
        params, key = jax.device_put((params, prng.key(0)), self.tools.devices[0])
        self._score_batch.lower(params, prng.fold_in(key, 0)).compile()

    def compile_probe(self, params: Any, num_levels: int) -> None:
        levels = jax.eval_shape(lambda: self._empty_levels(min(num_levels, self.num_slots)))
        self._play.lower(params, levels, prng.key(0), self.tools.config.scoring_steps).compile()

    def _empty_levels(self, num_levels: int) -> Level:
        """[num_levels, ...], for their shapes."""
        level = empty_level(self.tools.capacity)
        return jax.tree.map(lambda x: jnp.broadcast_to(x, (num_levels, *jnp.shape(x))), level)

    def _score(self, params: Any, key: Array) -> tuple[Level, Array, Array]:
        level_key, play_key = prng.split(key)
        levels = self.tools.draw_fresh(level_key[None], self.tools.config.scoring_batch)
        outcome = self.tools.play(params, levels, play_key, self.tools.config.scoring_steps)
        return levels, outcome.num_solved, outcome.num_finished


def _pick(batches: tuple[Level, ...], slots: Array) -> Level:
    return jax.tree.map(lambda *xs: jnp.concatenate(xs)[slots], *batches)
