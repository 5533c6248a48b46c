"""ACCEL (Parker-Holder et al. 2022, "Evolving Curricula with Regret-Based Environment Design").

Robust PLR of which part of the new levels are children of levels in the buffer: what the group plays of the buffer in
this update, each after `accel.num_changes` random mutators. Children are scored as fresh levels are, by what training
sees of them, and give no gradient; those that score higher than others in the buffer take their slots. So levels grow
from simple ones at the frontier of what the policy can do.

Children are drawn as fresh levels are: twice as many as are played, those that solve themselves left out, unless
`curriculum.filter_noop` is off. While the buffer is empty they are children of fresh levels.

Departures from the paper: parents are the levels that are drawn for replay, not the easiest of a batch; and fresh
levels are drawn throughout (in the paper they only fill the buffer at first).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.curator.buffer_share import by_group, num_from_buffer
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.plr import RobustPlr
from kinetix_dist.level.generator import OVERSAMPLING, keep_unsolved
from kinetix_dist.level.level import Level


class Accel(RobustPlr):
    """New levels of a group are children first, then fresh ones."""

    sections = ("plr", "accel")
    sources = ("fresh", "replayed", "edited")

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        super().check(config, worlds_per_group)
        num_edited = _num_edited(config, worlds_per_group)
        num_new = worlds_per_group - num_from_buffer(config, worlds_per_group)
        if not 0 < num_edited < num_new:
            raise ValueError(
                f"accel.edited_share {config.accel.edited_share} of {num_new} new levels a group is {num_edited}; "
                "'accel' needs changed levels and fresh ones: change it, lower buffer_share, or play more worlds"
            )

    @classmethod
    def num_fresh(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        return super().num_fresh(config, worlds_per_group) - _num_edited(config, worlds_per_group)

    def new_levels(self, group_keys: Array, replayed: Level, fresh: Level) -> Level:
        num_edited, num_groups = _num_edited(self.tools.config, self.tools.worlds_per_group), group_keys.shape[0]
        is_filtered = self.tools.config.filter_noop
        num_drawn = (OVERSAMPLING if is_filtered else 1) * num_edited
        parents = jax.tree.map(lambda x: x[:, jnp.arange(num_drawn) % x.shape[1]], replayed)
        keys = jax.vmap(lambda key: prng.split(prng.fold_in(key, 2), num_drawn))(group_keys)
        # All groups are played together: one large batch instead of a few small ones.
        flat = jax.tree.map(lambda x: x.reshape(num_groups * num_drawn, *x.shape[2:]), parents)
        drawn = self.tools.edit(keys.reshape(-1), flat)
        children = by_group(drawn, num_groups)
        if is_filtered:
            is_trivial = self.tools.solves_itself(drawn).reshape(num_groups, num_drawn)
            keep = jax.vmap(lambda levels, trivial: keep_unsolved(levels, trivial, num_edited))
            children = keep(children, is_trivial)
        return jax.tree.map(lambda *xs: jnp.concatenate(xs, axis=1), children, fresh)

    def new_sources(self, num_groups: int) -> Array:
        num_edited = _num_edited(self.tools.config, self.tools.worlds_per_group)
        edited = jnp.full((num_groups, num_edited), self.sources.index("edited"), jnp.int32)
        return jnp.concatenate([edited, super().new_sources(num_groups)], axis=1)


def _num_edited(config: CurriculumConfig, worlds_per_group: int) -> int:
    return round(config.accel.edited_share * (worlds_per_group - num_from_buffer(config, worlds_per_group)))
