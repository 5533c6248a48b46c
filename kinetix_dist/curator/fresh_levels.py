"""Fresh random levels, without those that solve themselves.

Levels are drawn in groups, each from a key of its own: a group draws twice as many as it needs, plays them without
acting and keeps the first that did not solve themselves. Groups are what is spread over devices, so the levels do not
depend on how many there are.
"""

from __future__ import annotations

from collections.abc import Callable

import jax

from jax2d.scene import Array, Capacity
from kinetix_dist.level.filters import OVERSAMPLING, keep_unsolved
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level


def fresh_levels(
    group_keys: Array,
    levels_per_group: int,
    *,
    capacity: Capacity,
    generator: GeneratorConfig,
    solves_itself: Callable[[Level], Array],
) -> Level:
    """[groups * levels_per_group] levels, group by group.

    group_keys: [groups] PRNG keys, consumed. solves_itself: batch of levels -> [W] bool. A group in which more than
    half of the draws solve themselves is filled up with such levels, in the order drawn.
    """
    num_groups, num_drawn = group_keys.shape[0], OVERSAMPLING * levels_per_group
    drawn = jax.vmap(lambda key: generate_levels(key, num_drawn, capacity, generator))(group_keys)
    # All groups are played together: one large batch instead of a few small ones.
    flat = jax.tree.map(lambda x: x.reshape(num_groups * num_drawn, *x.shape[2:]), drawn)
    is_trivial = solves_itself(flat).reshape(num_groups, num_drawn)
    kept = jax.vmap(lambda levels, trivial: keep_unsolved(levels, trivial, levels_per_group))(drawn, is_trivial)
    return jax.tree.map(lambda x: x.reshape(num_groups * levels_per_group, *x.shape[2:]), kept)
