"""How much a policy can learn from a level, estimated from a few episodes.

Learnability (Sampling For Learnability): p (1 - p), p = solved / finished episodes. It is the variance of the
outcome: zero for a level that is always or never solved, 1/4 for one that is solved every other time.

Of one world p has no bias, where an episode always finishes (`actors/outcomes.py`). Its noise makes p (1 - p) too low
on average, by 1/n of it for n episodes; and the levels that are chosen for the highest values are those of which the
few episodes happened to differ, so that a buffer claims more than it has (`evaluation/learnability.py`).
"""

from __future__ import annotations

from jax2d.scene import Array


def solve_rate(num_solved: Array, num_finished: Array) -> Array:
    """Solved / finished, elementwise; 0 where no episode finished (nothing is known, so nothing is claimed).

    Of arrays of JAX or NumPy."""
    return num_solved / (num_finished + (num_finished == 0))


def learnability(num_solved: Array, num_finished: Array) -> Array:
    """p (1 - p), elementwise; 0 where no episode finished."""
    p = solve_rate(num_solved, num_finished)
    return p * (1.0 - p)
