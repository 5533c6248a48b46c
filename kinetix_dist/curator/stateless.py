"""Curricula without a state: a fixed set of levels, and domain randomization, where every level is new."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.curator.buffer_share import by_group, join_by_group, members
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal
from kinetix_dist.curator.fresh_pairs import with_pair
from kinetix_dist.level.level import Level


class Fixed(Curriculum):
    """World i plays level i modulo their number. State: the levels, [L, ...]."""

    takes_levels = True
    draws_levels = False
    sources = ()  # all levels are counted one by one

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        self._levels = tools.load_levels(tools.config.levels)

    @property
    def num_slots(self) -> int:
        """Levels of the set."""
        return int(self._levels.position.shape[0])

    def init(self) -> Level:
        return self._levels

    def propose(self, state: Any, group_keys: Array, groups: Array) -> Proposal:
        del group_keys
        index = members(groups, self.tools.worlds_per_group) % state.position.shape[0]
        return Proposal(levels=jax.tree.map(lambda x: jnp.asarray(x)[index], state), source=index)


class DomainRandomization(Curriculum):
    """No state."""

    sources = ("fresh",)

    def propose(self, state: Any, group_keys: Array, groups: Array) -> Proposal:
        del state, groups
        fresh_keys, num_groups = jax.vmap(prng.split)(group_keys)[:, 1], group_keys.shape[0]
        drawn = by_group(self.tools.draw_fresh(fresh_keys, self.tools.worlds_per_group), num_groups)
        levels, copy_of = with_pair(group_keys, drawn)
        return Proposal(levels=join_by_group(levels), copy_of=copy_of)
