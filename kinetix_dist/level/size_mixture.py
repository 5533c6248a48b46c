"""Random levels of several sizes in arrays of one capacity: which share is of which size (`curriculum.sizes`).

Shares are exact, in whole levels of a group of worlds or of a batch of candidates: of n
levels each size has n * weight / sum of weights, rounded down, and the sizes with the largest remainders one more.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from jax2d.scene import Array, Capacity
from kinetix_dist import prng
from kinetix_dist.errors import quoted
from kinetix_dist.level.fit import pad_levels
from kinetix_dist.level.generator import generate_levels
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import SIZES, Level

Weights = Sequence[tuple[str, float]]  # of sizes by name; they need not add up to 1
Counts = tuple[tuple[str, int], ...]  # levels of each size


def check_weights(name: str, weights: Weights) -> None:
    """Raises ValueError, one line, for invalid weights of a mixture. name: that of the setting."""
    for pair in weights:
        if not isinstance(pair, list | tuple) or len(pair) != 2 or not isinstance(pair[0], str):
            raise ValueError(f"{name} has {quoted(pair)}; give pairs of a size and its weight")
        size, weight = pair
        if size not in SIZES:
            raise ValueError(f"{name} has {quoted(size)}; sizes are {', '.join(SIZES)}")
        if not isinstance(weight, numbers.Real) or isinstance(weight, bool):
            raise ValueError(f"{name} gives {size!r} the weight {quoted(weight)}; it must be a number")
        if not (math.isfinite(weight) and weight >= 0.0):
            raise ValueError(f"{name} gives {size!r} the weight {weight}; weights must be 0 or more")
    sizes = [size for size, _ in weights]
    if twice := [size for size in SIZES if sizes.count(size) > 1]:
        raise ValueError(f"{name} has {twice[0]!r} twice; give each size one weight")
    if weights and not any(weight for _, weight in weights):
        raise ValueError(f"{name} gives all sizes the weight 0; give at least one a positive weight")


def sizes_drawn(weights: Weights) -> list[str]:
    """Sizes of positive weight, the smallest first."""
    drawn = {size for size, weight in weights if weight}
    return [size for size in SIZES if size in drawn]


def counts_of(weights: Weights, num_levels: int) -> Counts:
    """Number of levels of each size of positive weight, of `num_levels`, the smallest size first.

    Raises ValueError where a size would have none.
    """
    weight_of = dict(weights)
    sizes = sizes_drawn(weights)
    total = math.fsum(weight_of[size] for size in sizes)
    exact = {size: num_levels * weight_of[size] / total for size in sizes}
    counts = {size: math.floor(exact[size]) for size in sizes}
    by_remainder = sorted(sizes, key=lambda size: counts[size] - exact[size])
    for size in by_remainder[: num_levels - sum(counts.values())]:
        counts[size] += 1
    if none := [size for size in sizes if not counts[size]]:
        raise ValueError(
            f"curriculum.sizes: of {num_levels} levels that are drawn together none would be of size {none[0]!r}; "
            "raise its weight, or draw more levels together (rollout.num_envs for each of rollout.num_groups, "
            "curriculum.scoring_batch)"
        )
    return tuple(counts.items())


def generate_mixture(key: Array, counts: Counts, capacity: Capacity, config: GeneratorConfig) -> Level:
    """Random levels in arrays of `capacity`, [sum of counts, ...], size by size. Works inside jit; consumes the key.

    Those of a size depend on the key and on the size alone: not on which other sizes there are.
    """
    parts = [generate_levels(key_of_size(size, key), number, SIZES[size], config) for size, number in counts]
    return jax.tree.map(lambda *xs: jnp.concatenate(xs), *(pad_levels(part, capacity) for part in parts))


def key_of_size(size: str, key: Array) -> Array:
    """Key of the levels of that size of a mixture."""
    return prng.fold_in(key, list(SIZES).index(size))
