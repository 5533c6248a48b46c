"""Prioritized Level Replay (Jiang et al. 2021): levels are played again by what training saw of them.

    propose   of each group, `buffer_share` of the worlds play levels of the buffer, drawn by `replay_chances`, the
              others fresh ones
    summarise values, advantages and returns of what was played, for scores
    observe   the score of what was played: levels of the buffer get a new one, new levels take slots of others

Departures from the paper, which plays one level at a time: an update plays `buffer_share` of its levels from the
buffer, where the paper decides by chance for each; age counts updates, not episodes; and replay begins when the buffer
has any level. Before that, in the first update (the first two in the split placement), the worlds of the buffer repeat
the fresh levels of their group.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.curator.buffer_share import by_group, join_by_group, num_from_buffer
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.curriculum import Curriculum, Proposal
from kinetix_dist.curator.replay_buffer import (
    NEVER,
    ReplayBuffer,
    buffer_log,
    empty_buffer,
    level_rates,
    played_again,
    replay_chances,
    taken_in,
    with_returns,
)
from kinetix_dist.curator.scores import NUM_EPISODES, REPLAY_SCORES, ValueSummary, summarise_values
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.level import Level
from kinetix_dist.messages import LevelOutcome, Trajectory


class Plr(Curriculum):
    """Its state is the `ReplayBuffer`. Tags: slot in the buffer, `born` of the level there, whether it is new."""

    observes = True
    sections = ("plr",)
    sources = ("fresh", "replayed")

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        num_replayed = num_from_buffer(config, worlds_per_group)
        if not 0 < num_replayed < worlds_per_group:
            raise ValueError(
                f"buffer_share {config.buffer_share} of {worlds_per_group} worlds a group is {num_replayed}; "
                f"{config.name!r} needs worlds of both kinds, the others bring the levels of its buffer"
            )
        _ = REPLAY_SCORES[config.plr.score]  # raises for an unknown one

    @classmethod
    def num_episodes(cls, config: CurriculumConfig) -> int:
        return NUM_EPISODES.get(config.plr.score, 0)

    def init(self) -> ReplayBuffer:
        level = generate_level(prng.key(0), self.tools.capacity, self.tools.config.generator)
        return empty_buffer(level, self.tools.config.buffer_size)

    def propose(self, state: ReplayBuffer, group_keys: Array, groups: Array) -> Proposal:
        """A group's worlds are those of the buffer first, then the fresh ones."""
        del groups
        size, num_groups = self.tools.worlds_per_group, group_keys.shape[0]
        num_replayed, num_fresh = num_from_buffer(self.tools.config, size), self.num_fresh(self.tools.config, size)
        split = jax.vmap(prng.split)(group_keys)
        fresh = by_group(self.tools.draw_fresh(split[:, 1], num_fresh), num_groups)

        log_chances, shape = jnp.log(replay_chances(state, self.tools.config.plr)), (num_replayed,)
        slot = jax.vmap(lambda key: prng.categorical(key, log_chances, shape=shape))(split[:, 0])
        is_empty = ~state.is_filled.any()
        repeated = jnp.arange(num_replayed) % num_fresh
        replayed = jax.tree.map(
            lambda buffered, new: jnp.where(is_empty, new[:, repeated], buffered[slot]), state.levels, fresh
        )
        new = self.new_levels(group_keys, replayed, fresh)
        no_slot = jnp.zeros((num_groups, size - num_replayed), jnp.int32)
        tags = (
            {"slot": slot.astype(jnp.int32), "born": state.born[slot], "is_new": jnp.zeros(slot.shape, bool)},
            {"slot": no_slot, "born": no_slot + NEVER, "is_new": jnp.ones(no_slot.shape, bool)},
        )
        replayed_from = jnp.where(is_empty, self.sources.index("fresh"), self.sources.index("replayed"))
        sources = jnp.broadcast_to(replayed_from, slot.shape), self.new_sources(num_groups)
        return Proposal(levels=join_by_group(replayed, new), tags=join_by_group(*tags), source=join_by_group(*sources))

    @classmethod
    def num_fresh(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        return worlds_per_group - num_from_buffer(config, worlds_per_group)

    def new_levels(self, group_keys: Array, replayed: Level, fresh: Level) -> Level:
        """New levels of a group, next to those of the buffer: [groups, new, ...]. replayed, fresh: [groups, ...]."""
        del group_keys, replayed
        return fresh

    def new_sources(self, num_groups: int) -> Array:
        """[groups, new] int32, where `new_levels` come from."""
        num_fresh = self.num_fresh(self.tools.config, self.tools.worlds_per_group)
        return jnp.full((num_groups, num_fresh), self.sources.index("fresh"), jnp.int32)

    def summarise(self, trajectory: Trajectory, last_value: Array) -> ValueSummary:
        return summarise_values(trajectory, self.tools.advantages(trajectory, last_value))

    def observe(self, state: ReplayBuffer, proposal: Proposal, outcome: LevelOutcome) -> ReplayBuffer:
        config, tags = self.tools.config.plr, proposal.tags
        # In the split placement a level may have lost its slot since it was proposed.
        is_there = (tags["born"] != NEVER) & (tags["born"] == state.born[tags["slot"]])
        state, best_return = with_returns(state, tags["slot"], outcome.summary.max_return, is_there)
        size = state.score.shape[0]
        rates = level_rates(tags["slot"], is_there, outcome.num_solved, outcome.num_finished, size)
        outcome = dataclasses.replace(outcome, summary=dataclasses.replace(outcome.summary, solve_rate=rates))
        score = REPLAY_SCORES[config.score](outcome, best_return)
        state = played_again(state, tags["slot"], score, is_there)
        state = taken_in(state, proposal.levels, score, best_return, tags["is_new"], config)
        return dataclasses.replace(state, num_updates=state.num_updates + 1)

    @classmethod
    def buffer_log(cls, state: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        return buffer_log(state)

    def metrics(self, state: ReplayBuffer, num_updates: int) -> dict[str, Any]:
        del num_updates
        is_filled = np.asarray(state.is_filled)
        score, age = np.asarray(state.score)[is_filled], np.asarray(state.num_updates - state.last_played)[is_filled]
        return {
            "curriculum/filled_share": is_filled.mean(),
            "curriculum/replay_score": score.mean() if score.size else np.nan,
            "curriculum/replay_age": age.mean() if age.size else np.nan,
        }


class RobustPlr(Plr):
    """Its worlds of the buffer are the first ones of each group."""

    @classmethod
    def num_trained(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        return num_from_buffer(config, worlds_per_group)
