"""Fixed levels: a given set, spread evenly over the worlds."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.curator.curriculum import Curriculum, CurriculumTools, Proposal


class Fixed(Curriculum):
    """World i plays level i modulo their number. No state."""

    takes_levels = True
    sources = ()  # all levels are counted one by one

    def __init__(self, tools: CurriculumTools) -> None:
        super().__init__(tools)
        self._levels = tools.load_levels(tools.config.levels)

    @property
    def num_places(self) -> int:
        """Levels of the set."""
        return int(self._levels.position.shape[0])

    def propose(self, state: Any, group_keys: Array, groups: Array) -> Proposal:
        del state, group_keys
        size = self.tools.worlds_per_group
        world = (groups[:, None] * size + jnp.arange(size)).reshape(-1)
        index = world % self.num_places
        return Proposal(levels=jax.tree.map(lambda x: jnp.asarray(x)[index], self._levels), source=index)
