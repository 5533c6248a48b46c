"""Random levels without those that solve themselves (paper, section 4: rejection of levels a no-op policy solves)."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.level.fit import capacity_of_size
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level

OVERSAMPLING = 2  # levels drawn for each one kept; about one in ten solves itself


def generate_filtered(
    key: Array,
    num_levels: int,
    size: str,
    config: GeneratorConfig,
    noop_outcome_fn: Callable[[Level], Array],
) -> Level:
    """`num_levels` random levels of a size, those that nobody needs to play left out.

    Draws twice as many and keeps the first ones that `noop_outcome_fn(levels) -> [W] bool` does not call solved, in
    the order drawn. Should more than half of the draw be solved, the last ones kept are among the solved. Pure; works
    inside jit. Consumes `key`.
    """
    drawn = generate_levels(key, OVERSAMPLING * num_levels, capacity_of_size(size), config)
    return keep_unsolved(drawn, noop_outcome_fn(drawn), num_levels)


@functools.partial(jax.jit, static_argnames="num_levels")
def keep_unsolved(levels: Level, is_solved: Array, num_levels: int) -> Level:
    """The first `num_levels` of a batch that are not solved, then solved ones if there are not enough."""
    order = jnp.argsort(is_solved, stable=True)[:num_levels]
    return jax.tree.map(lambda x: x[order], levels)
