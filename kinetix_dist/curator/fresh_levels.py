"""Fresh random levels, by default without those that solve themselves.

Levels are drawn in groups, each from a key of its own: a group draws twice as many as it needs, plays them without
acting and keeps the first that did not solve themselves. Without this filter it draws as many as it needs, and plays
none. Groups are what is spread over devices, so the levels do not depend on how many there are. Where sizes are mixed,
a group has each size's share of them, the smallest size first.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from jax2d.scene import Array, Capacity
from kinetix_dist.level.fit import pad_levels
from kinetix_dist.level.generator import OVERSAMPLING, keep_unsolved, level_keys
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.generator_program import draw_levels
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.size_mixture import Weights, counts_of, key_of_size


def fresh_levels(
    group_keys: Array,
    levels_per_group: int,
    *,
    capacity: Capacity,
    generator: GeneratorConfig,
    solves_itself: Callable[[Level], Array] | None,
    sizes: Weights = (),
) -> Level:
    """[groups * levels_per_group] levels, group by group.

    group_keys: [groups] PRNG keys, consumed. solves_itself: batch of levels -> [W] bool; None: whatever is drawn is
    kept. A group in which more than half of the draws solve themselves is filled up with such levels, in the order
    drawn. sizes: `curriculum.sizes`; none: all levels are of the size that `capacity` is.
    """
    oversampling = 1 if solves_itself is None else OVERSAMPLING
    num_groups, num_drawn = group_keys.shape[0], oversampling * levels_per_group
    if sizes:
        kept_counts = [number for _, number in counts_of(sizes, levels_per_group)]
        parts = [
            _draw(
                jax.vmap(functools.partial(key_of_size, size))(group_keys),
                oversampling * number,
                SIZES[size],
                generator,
                capacity,
            )
            for size, number in counts_of(sizes, levels_per_group)
        ]
    else:
        kept_counts = [levels_per_group]
        parts = [_draw(group_keys, num_drawn, capacity, generator, capacity)]
    drawn = jax.tree.map(lambda *xs: jnp.concatenate(xs, axis=1), *parts)
    # All groups are played together: one large batch instead of a few small ones.
    flat = jax.tree.map(lambda x: x.reshape(num_groups * num_drawn, *x.shape[2:]), drawn)
    if solves_itself is None:
        return flat
    is_trivial = solves_itself(flat).reshape(num_groups, num_drawn)
    kept = jax.vmap(lambda levels, trivial: _keep_by_size(levels, trivial, kept_counts))(drawn, is_trivial)
    return jax.tree.map(lambda x: x.reshape(num_groups * levels_per_group, *x.shape[2:]), kept)


def _draw(group_keys: Array, number: int, size: Capacity, generator: GeneratorConfig, arrays: Capacity) -> Level:
    """[groups, number] levels of a size, in arrays of a capacity."""
    keys = jax.vmap(lambda key: level_keys(key, number))(group_keys)
    levels = pad_levels(draw_levels(keys.reshape(-1), size, generator), arrays)
    return jax.tree.map(lambda x: x.reshape(*keys.shape, *x.shape[1:]), levels)


def _keep_by_size(levels: Level, is_trivial: Array, counts: Sequence[int]) -> Level:
    """Levels of a group, drawn size by size: as many of each as in `counts`."""

    def keep(start: int, number: int) -> Level:
        drawn = slice(start, start + OVERSAMPLING * number)
        return keep_unsolved(jax.tree.map(lambda x: x[drawn], levels), is_trivial[drawn], number)

    starts = itertools.accumulate((OVERSAMPLING * number for number in counts), initial=0)
    parts = [keep(start, number) for start, number in zip(starts, counts, strict=False)]
    return parts[0] if len(parts) == 1 else jax.tree.map(lambda *xs: jnp.concatenate(xs), *parts)
