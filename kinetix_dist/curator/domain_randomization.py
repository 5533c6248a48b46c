"""Domain randomization: every level is new and comes from the generator."""

from __future__ import annotations

from typing import Any

import jax

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.curator.curriculum import Curriculum, Proposal


class DomainRandomization(Curriculum):
    """No state."""

    sources = ("fresh",)

    def propose(self, state: Any, group_keys: Array, groups: Array) -> Proposal:
        del state, groups
        fresh_keys = jax.vmap(prng.split)(group_keys)[:, 1]
        return Proposal(levels=self.tools.draw_fresh(fresh_keys, self.tools.worlds_per_group))
