"""ACCEL (Parker-Holder et al. 2022, "Evolving Curricula with Regret-Based Environment Design").

Robust PLR of which part of the new levels are children of levels in the buffer: what the group plays of the buffer in
this update, each after `accel.num_changes` random mutators. Children are scored as fresh levels are, by what training
sees of them, and give no gradient; those that score higher than others in the buffer take their places. So levels grow
from simple ones at the frontier of what the policy can do.

Departures from the paper: parents are the levels that are drawn for replay, not the easiest of a batch; fresh levels go
on being drawn beside (there they only fill the buffer at first); and where a child solves itself without any action, a
fresh level is played in its place.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.curator.buffer_share import num_from_buffer
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.replay_buffer import ReplayBuffer
from kinetix_dist.curator.robust_plr import RobustPlr
from kinetix_dist.level.level import Level


class Accel(RobustPlr):
    """New levels of a group are children first, then fresh ones."""

    sections = ("plr", "accel")

    @classmethod
    def check(cls, config: CurriculumConfig, worlds_per_group: int) -> None:
        super().check(config, worlds_per_group)
        if _num_edited(config, worlds_per_group) < 1:
            num_new = worlds_per_group - num_from_buffer(config, worlds_per_group)
            raise ValueError(
                f"accel.edited_share {config.accel.edited_share} of {num_new} new levels a group is none; 'accel' "
                "needs one or more: raise it, lower buffer_share, or play more worlds"
            )

    def new_levels(self, state: ReplayBuffer, group_keys: Array, replayed: Level, fresh: Level) -> Level:
        num_edited = _num_edited(self.tools.config, self.tools.worlds_per_group)
        num_groups = group_keys.shape[0]
        parents = jax.tree.map(lambda x: x[:, jnp.arange(num_edited) % x.shape[1]], replayed)
        keys = jax.vmap(lambda key: jax.random.split(jax.random.fold_in(key, 2), num_edited))(group_keys)
        flat = jax.tree.map(lambda x: x.reshape(num_groups * num_edited, *x.shape[2:]), parents)
        children = self.tools.edit(keys.reshape(-1), flat)
        is_trivial = self.tools.solves_itself(children).reshape(num_groups, num_edited)
        is_fresh = is_trivial | ~state.is_filled.any()

        def join(child: Array, new: Array) -> Array:
            child = child.reshape(num_groups, num_edited, *child.shape[1:])
            left_out = is_fresh.reshape(num_groups, num_edited, *(1,) * (child.ndim - 2))
            return jnp.concatenate([jnp.where(left_out, new[:, :num_edited], child), new[:, num_edited:]], axis=1)

        return jax.tree.map(join, children, fresh)


def _num_edited(config: CurriculumConfig, worlds_per_group: int) -> int:
    return round(config.accel.edited_share * (worlds_per_group - num_from_buffer(config, worlds_per_group)))
