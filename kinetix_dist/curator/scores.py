"""Learnability: how much a policy can learn from a level, estimated from a few episodes.

Learnability (Sampling For Learnability): p (1 - p), p = solved / finished episodes. It is the variance of the
outcome: zero for a level that is always or never solved, 1/4 for one that is solved every other time.

Of one world p has no bias, where an episode always finishes (`actors/outcomes.py`). Its noise makes p (1 - p) too low
on average, by 1/n of it for n episodes; and the levels that are chosen for the highest values are those of which the
few episodes happened to differ, so that a buffer claims more than it has (`evaluation/learnability.py`).
"""

from __future__ import annotations

import numpy as np

from jax2d.scene import Array


def solve_rate(num_solved: Array, num_finished: Array) -> Array:
    """Solved / finished, elementwise; 0 where no episode finished (nothing is known, so nothing is claimed).

    Of arrays of JAX or NumPy."""
    return num_solved / (num_finished + (num_finished == 0))


def learnability(num_solved: Array, num_finished: Array) -> Array:
    """p (1 - p), elementwise; 0 where no episode finished."""
    p = solve_rate(num_solved, num_finished)
    return p * (1.0 - p)


def exact_keys(num_solved: np.ndarray, num_finished: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Integers [n] in the order of learnability, and [n] in that of the solve rate; equal where these are equal.

    In floats p (1 - p) of p and of 1 - p differ by rounding. With f at most F, two different learnabilities
    s (f - s) / f^2 are 1 / F^4 apart or more, and two rates 1 / F^2: scaled by that and rounded down, they still
    differ. The scaled numbers are below F^6 / 4; where that is beyond 64 bits they are integers of Python.
    """
    most = int(num_finished.max(initial=1))
    kind = np.int64 if most**6 < 2**64 else object
    solved, finished = num_solved.astype(np.int64).astype(kind), num_finished.astype(np.int64).astype(kind)
    divisor = finished + (finished == 0)
    return solved * (finished - solved) * most**4 // divisor**2, solved * most**2 // divisor
