"""Sampling For Learnability with a buffer of any size that is renewed in slices, see `slice_buffer.py`.

    propose   of each group, `buffer_share` of the worlds play levels of the buffer that are in use, the others fresh
    observe   plays of its levels are counted, levels leave, fresh levels that were solved become candidates
    refresh   `num_candidates` candidates, the first of them from training, are scored by successive halving
              (`halving.py`); the best `slice_size` are adopted. The first refresh fills the buffer: it has as many
              times the candidates as there are slices

Halving ranks the candidates of a scoring batch among themselves, so that batches need nothing of each other: the
slice is the same to the bit however many processes and devices share a refresh. A fresh level that training solved
once has had one of its attempts. Of these more are learnable than of levels of which nothing is known: solved, then
not solved, has the chance E[p (1 - p)] / E[p], where two attempts of any level differ with chance 2 E[p (1 - p)].
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.checkpoint import select_arrays
from kinetix_dist.curator.buffer_share import by_group, join_by_group, num_from_buffer
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.curator.fresh_pairs import is_copy, with_pair
from kinetix_dist.curator.halving import Attempts, Halving
from kinetix_dist.curator.level_buffer import Candidates, LevelBuffer, Scored, keep_best, refresh_log, scored
from kinetix_dist.curator.scores import learnability
from kinetix_dist.curator.slice_buffer import (
    SliceBuffer,
    draw_slots,
    filled,
    harvested,
    played,
    slice_metrics,
    with_slice,
)
from kinetix_dist.level.features import FEATURES, features_of_arrays, level_features
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.level import Level
from kinetix_dist.level.size_mixture import counts_of
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.telemetry.curriculum_log import LEVELS

NO_LEVEL = -1  # in the tags: the world plays a fresh level


class SflSlices(Curriculum):
    """Its state is the `SliceBuffer`. Tags: slot in the buffer, and the policy version that chose the level there."""

    observes = True
    refreshes = True
    refreshes_from_state = True
    shares_refresh = True
    needs_whole_episodes = True
    sources = ("fresh", "buffer")
    sections = ("slices",)

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        slices, batch = tools.config.slices, tools.config.scoring_batch
        self._halving = Halving(batch, slices.attempts, slices.num_in_rounds(batch))
        self._draw = jax.jit(lambda key: tools.draw_fresh(key[None], batch))
        self._play = jax.jit(self._play_launch)
        self._pick = jax.jit(lambda levels, slots: jax.tree.map(lambda x: x[slots], levels))
        self._features = jax.jit(level_features)

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        num_fresh = cls.num_fresh(config, worlds_per_group)
        slices, batch = config.slices, config.scoring_batch
        if config.sizes:
            counts_of(config.sizes, batch)
        if config.buffer_size % slices.slice_size:
            raise ValueError(
                f"CurriculumConfig.buffer_size {config.buffer_size} is not a multiple of slices.slice_size "
                f"{slices.slice_size}; change one of them"
            )
        if (num_last := slices.num_in_rounds(batch)[-1] * config.num_batches) < slices.slice_size:
            raise ValueError(
                f"of {config.num_candidates} candidates {num_last} are left in the last round of "
                f"slices.keep_one_of {slices.keep_one_of}, fewer than slices.slice_size {slices.slice_size}; raise "
                "num_candidates or lower one of them"
            )
        if slices.num_harvested % batch or slices.num_harvested > config.num_candidates:
            raise ValueError(
                f"slices.num_harvested is {slices.num_harvested}; it must be a multiple of scoring_batch {batch}, up "
                f"to num_candidates {config.num_candidates}"
            )
        if slices.num_harvested and not num_fresh:
            raise ValueError(
                f"slices.num_harvested is {slices.num_harvested}, but with buffer_share {config.buffer_share} no fresh "
                "level is played; set it to 0 or lower buffer_share"
            )

    @classmethod
    def num_fresh(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        return worlds_per_group - num_from_buffer(config, worlds_per_group)

    def init(self) -> SliceBuffer:
        config = self.tools.config
        level = generate_level(prng.key(0), self.tools.capacity, config.generator)
        count = jnp.zeros(config.buffer_size, jnp.int32)
        nothing = LevelBuffer(
            levels=jax.tree.map(lambda x: jnp.broadcast_to(x, (config.buffer_size, *jnp.shape(x))), level),
            candidate=count,
            score=count.astype(jnp.float32),
            num_solved=count,
            num_finished=count,
            policy_version=jnp.int32(0),
            mean_candidate_score=jnp.float32(0),
            learnable_share=jnp.float32(0),
        )
        return filled(nothing, config.slices)

    def propose(self, state: SliceBuffer | None, group_keys: Array, groups: Array) -> Proposal:
        """A group's worlds are those of the buffer first, then the fresh ones."""
        del groups
        if state is None:
            raise ValueError("a curriculum with a buffer cannot propose levels before it is filled")
        size, num_groups = self.tools.worlds_per_group, group_keys.shape[0]
        num_fresh = self.num_fresh(self.tools.config, size)
        num_buffered = size - num_fresh
        split = jax.vmap(prng.split)(group_keys)
        parts, tags, sources, copy_of = [], [], [], None

        def add(levels: Level, slot: Array, version: Array, source: str) -> None:
            parts.append(levels)
            tags.append({"slot": slot, "version": version})
            sources.append(jnp.full(slot.shape, self.sources.index(source), jnp.int32))

        if num_buffered:
            slot = jax.vmap(lambda key: draw_slots(key, state, num_buffered))(split[:, 0])
            levels = jax.tree.map(lambda x: x[slot], state.levels)
            add(levels, slot, state.policy_version[slot], "buffer")
        if num_fresh:
            none = jnp.full((num_groups, num_fresh), NO_LEVEL, jnp.int32)
            drawn = by_group(self.tools.draw_fresh(split[:, 1], num_fresh), num_groups)
            levels, copy_of = with_pair(group_keys, drawn, num_buffered)
            add(levels, none, none, "fresh")
        return Proposal(
            levels=join_by_group(*parts),
            tags=join_by_group(*tags),
            source=join_by_group(*sources),
            copy_of=copy_of,
        )

    def observe(self, state: SliceBuffer, proposal: Proposal, outcome: LevelOutcome) -> SliceBuffer:
        config = self.tools.config.slices
        slot, version = proposal.tags["slot"], proposal.tags["version"]
        is_fresh = slot == NO_LEVEL
        # In the split placement another level may have taken the slot since.
        is_there = ~is_fresh & (version == state.policy_version[slot])
        if config.num_harvested:
            # One candidate for each level, by one attempt: copies are left out.
            is_solved = is_fresh & ~is_copy(proposal.copy_of) & (outcome.first_solved > 0)
            harvest = harvested(state.harvest, proposal.levels, is_solved, state.num_updates)
            state = dataclasses.replace(state, harvest=harvest)
        return played(state, slot, outcome.first_solved, is_there, config)

    def refresh_input(self, state: SliceBuffer | None) -> dict[str, Any] | None:
        """Fresh levels that were solved since the last request of a refresh, newest first; "count": how many."""
        if state is None or not self.tools.config.slices.num_harvested:
            return None
        is_new = state.harvest.solved_at >= jnp.maximum(0, state.num_updates - self.tools.config.refresh_every)
        return {"levels": state.harvest.levels, "count": jnp.asarray(is_new.sum(), jnp.int32)}

    def refresh_part(
        self,
        params: Any,
        policy_version: int,
        key: Array,
        part: int,
        num_parts: int,
        given: Mapping[str, Any] | None = None,
    ) -> Scored:
        """Every `num_parts`-th batch of the candidates, scored by `params`. Those from training come first, in whole
        batches."""
        config = self.tools.config
        is_first = self.tools.is_first_refresh(policy_version)  # it fills the buffer
        num_slices = config.buffer_size // config.slices.slice_size if is_first else 1
        batch_size = config.scoring_batch
        batches = range(part, num_slices * config.num_batches, num_parts)
        num_harvested = 0 if given is None else int(given["count"]) // batch_size
        devices = self.tools.devices[: len(batches)]
        placed = [jax.device_put((params, key), device) for device in devices]

        def score(index: int, batch: int) -> tuple[Attempts, Level, Array]:
            params, key = placed[index % len(devices)]
            level_key, play_key = prng.split(prng.fold_in(key, batch))
            if is_harvested := batch < num_harvested:
                assert given is not None
                one_batch = slice(batch * batch_size, (batch + 1) * batch_size)
                levels = jax.device_put(
                    jax.tree.map(lambda x: np.asarray(x)[one_batch], given["levels"]), devices[index % len(devices)]
                )
            else:
                levels = self._draw(level_key)
            known = {"num_solved": 1, "num_known": 1} if is_harvested else {}
            tried = self._halving(lambda number, key: self._play(params, levels, number, key), play_key, **known)
            return tried, self._pick(levels, tried.finalists), self._features(levels)

        found = []
        for start in range(0, len(batches), len(devices)):
            # All devices get work before any is waited for; finalists go to the host before the next ones.
            launched = [score(index, batch) for index, batch in enumerate(batches[start : start + len(devices)])]
            found.extend(jax.device_get(launched))
        tried, finalists, features = zip(*found, strict=True)
        candidate = np.concatenate([batch * batch_size + np.arange(batch_size) for batch in batches])
        slot_of = np.full(len(candidate), -1)  # of a candidate among the finalists
        finalists_of_all = np.concatenate([index * batch_size + each.finalists for index, each in enumerate(tried)])
        slot_of[finalists_of_all] = np.arange(len(finalists_of_all))
        num_solved, num_attempts = (
            np.concatenate([getattr(each, name) for each in tried]) for name in ("num_solved", "num_attempts")
        )
        return scored(
            Candidates(candidate, num_solved, num_attempts, np.concatenate(features)),
            lambda index: jax.tree.map(lambda *xs: np.concatenate(xs)[slot_of[index]], *finalists),
            size=num_slices * config.slices.slice_size,
            policy_version=policy_version,
            min_finished=config.slices.attempts[-1],
        )

    def join(self, parts: Sequence[Scored]) -> LevelBuffer:
        """A slice, or at first a whole buffer."""
        return keep_best(parts, num_adopted(self.tools.config, parts), self.tools.config.slices.attempts[-1])

    def adopt(self, state: SliceBuffer | None, refreshed: LevelBuffer) -> SliceBuffer:
        if state is None:
            return filled(refreshed, self.tools.config.slices)
        return with_slice(state, refreshed)

    def metrics(self, state: SliceBuffer | None, num_updates: int) -> dict[str, Any]:
        return {} if state is None else slice_metrics(state, num_updates)

    @classmethod
    def refresh_log(cls, config: CurriculumConfig, parts: Sequence[Scored]) -> dict[str, np.ndarray]:
        """Arrays of the adopted levels alone."""
        return refresh_log(parts, num_adopted(config, parts), config.slices.attempts[-1])

    @classmethod
    def buffer_log(cls, state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Arrays of a buffer_*.npz from those of a `SliceBuffer` by path."""
        levels = select_arrays(state, "levels")
        solved, finished = state["num_solved"], state["num_finished"]
        return {
            "policy_version": np.asarray(state["num_updates"], np.int32),
            "slot": np.arange(len(solved), dtype=np.int32),
            "score": learnability(solved.astype(np.float32), finished.astype(np.float32)),
            "solved": solved,
            "finished": finished,
            "born": state["policy_version"],
            "status": state["status"],
            "num_plays": state["num_plays"],
            "features": features_of_arrays(levels),
            "feature_names": np.array(FEATURES),
            **{f"{LEVELS}{path}": array for path, array in levels.items()},
        }

    def _play_launch(self, params: Any, levels: Level, number: Array, key: Array) -> Array:
        """[B] int32, 1 where the first episode of a world on its level was solved. number [B]: of these levels."""
        levels = jax.tree.map(lambda x: x[number], levels)
        return self.tools.play(params, levels, key, self.tools.max_steps).first_solved


def num_adopted(config: CurriculumConfig, parts: Sequence[Scored]) -> int:
    """Levels that a refresh adopts: a slice of each `num_candidates`; of the first one as many as fill the buffer."""
    return sum(len(part.candidate) for part in parts) // config.num_candidates * config.slices.slice_size
