"""How much a policy can learn from a level, estimated from a few episodes.

Learnability (Sampling For Learnability): p (1 - p), p = solved / finished episodes. It is the variance of the
outcome: zero for a level that is always or never solved, 1/4 for one that is solved every other time.
"""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array


def solve_rate(num_solved: Array, num_finished: Array) -> Array:
    """Solved / finished, elementwise; 0 where no episode finished (nothing is known, so nothing is claimed)."""
    return num_solved / jnp.maximum(num_finished, 1)


def learnability(num_solved: Array, num_finished: Array) -> Array:
    """p (1 - p), elementwise; 0 where no episode finished."""
    p = solve_rate(num_solved, num_finished)
    return p * (1.0 - p)


def learnability_interval(num_solved: Array, num_finished: Array, *, z: float = 1.96) -> tuple[Array, Array]:
    """Range of p (1 - p) over the Wilson interval of p (z = 1.96: 95 %): with two episodes it is nearly everything."""
    n = jnp.maximum(num_finished, 1)
    p = num_solved / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * jnp.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    low_p, high_p = centre - half, centre + half
    at_ends = jnp.stack([low_p * (1 - low_p), high_p * (1 - high_p)])
    holds_peak = (low_p <= 0.5) & (high_p >= 0.5)
    return at_ends.min(axis=0), jnp.where(holds_peak, 0.25, at_ends.max(axis=0))
