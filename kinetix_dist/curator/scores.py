"""Learnability: how much a policy can learn from a level, estimated from a few episodes.

Learnability (Sampling For Learnability): p (1 - p), p = solved / finished episodes. It is the variance of the
outcome: zero for a level that is always or never solved, 1/4 for one that is solved every other time.

Of one world p has no bias, where an episode always finishes (`actors/outcomes.py`). Its noise makes p (1 - p) too low
on average, by 1/n of it for n episodes; and the levels that are chosen for the highest values are those of which the
few episodes happened to differ, so that a buffer claims more than it has (`evaluation/learnability.py`).

Scores by which Prioritized Level Replay ranks levels, `curriculum.plr.score`: functions of an update's episodes.

| name | score of a level | source |
|---|---|---|
| `max_mc` | mean over steps of R - V(s_t), R: highest return of an episode of this level so far | Jiang et al. 2021b |
| `positive_value_loss` | mean over steps of max(A_t, 0), A_t: advantages (GAE) of the learner | Jiang et al. 2021b |
| `l1_value_loss` | mean over steps of abs(A_t) | Jiang et al. 2021a |
| `learnability` | p (1 - p), p: solve rate of the level | Rutherford et al. 2024 |
| `failure` | 1 - p: levels that are never solved come first | |

2021a: Prioritized Level Replay; 2021b: Replay-Guided Adversarial Environment Design. R is not discounted, V(s_t) is, as
in published code. All steps of an update count, those of an episode that did not end within it too.

p is that of the level: the mean over all worlds that played it of solved / finished episodes. p (1 - p) of a single
episode is 0, and a fresh level is played by one world: `learnability` needs two episodes in each (`NUM_EPISODES`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist.messages import LevelOutcome, Trajectory
from kinetix_dist.registry import Registry


def solve_rate(num_solved: Array, num_finished: Array) -> Array:
    """Solved / finished, elementwise; 0 where no episode finished (nothing is known, so nothing is claimed).

    Of arrays of JAX or NumPy."""
    return num_solved / (num_finished + (num_finished == 0))


def learnability(num_solved: Array, num_finished: Array) -> Array:
    """p (1 - p), elementwise; 0 where no episode finished."""
    p = solve_rate(num_solved, num_finished)
    return p * (1.0 - p)


def learnability_now(num_solved: np.ndarray, num_plays: np.ndarray) -> tuple[float, float]:
    """(p (1 - p) of the levels of a buffer, its standard error) from plays [K] of one update; nan without a level that
    was played twice.

    Pairs of plays of a level differ with chance 2 p (1 - p). How often a level is played does not depend on p, and
    levels that leave do so after this update: the estimate is unbiased, each level weighted by its pairs. Standard
    error of a ratio of sums over levels (Cochran, Sampling Techniques, section 6.4).
    """
    differ = num_solved.astype(np.float64) * (num_plays - num_solved)
    pairs = num_plays.astype(np.float64) * (num_plays - 1)
    if not pairs.any():
        return np.nan, np.nan
    mean = differ.sum() / pairs.sum()
    num_levels = int((pairs > 0).sum())
    if num_levels < 2:
        return mean, np.nan
    variance = ((differ - mean * pairs) ** 2).sum() * num_levels / (num_levels - 1)
    return mean, np.sqrt(variance) / pairs.sum()


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


NUM_EPISODES = {"learnability": 2}  # that have to end in each world of an update, by score; others need none
UNKNOWN = -jnp.inf  # the score of a level of which nothing is known: below all others


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class ValueSummary:
    """Returns and values of each world in a trajectory."""

    mean_value: Array  # [W] float32, of the value function, over all steps
    max_return: Array  # [W] float32, highest undiscounted return of an episode that ended, UNKNOWN without one
    positive_value_loss: Array  # [W] float32
    l1_value_loss: Array  # [W] float32
    # [W] float32, of the level of each world over all worlds that played it, UNKNOWN where no episode ended.
    # None before the worlds of an update are seen together.
    solve_rate: Array | None = None


def summarise_values(trajectory: Trajectory, advantages: Array) -> ValueSummary:
    """advantages [T, W]: of the steps of the trajectory, which begins with an episode."""
    return ValueSummary(
        mean_value=trajectory.values.mean(axis=0),
        max_return=highest_return(trajectory),
        positive_value_loss=jnp.maximum(advantages, 0.0).mean(axis=0),
        l1_value_loss=jnp.abs(advantages).mean(axis=0),
    )


def highest_return(trajectory: Trajectory) -> Array:
    """[W] float32, undiscounted, of the episodes that ended; UNKNOWN without one. Begins with an episode."""

    def step(carry: tuple[Array, Array], at: tuple[Array, Array]) -> tuple[tuple[Array, Array], None]:
        so_far, highest = carry
        reward, done = at
        so_far = so_far + reward
        highest = jnp.where(done, jnp.maximum(highest, so_far), highest)
        return (jnp.where(done, 0.0, so_far), highest), None

    zero = jnp.zeros_like(trajectory.rewards[0])
    (_, max_return), _ = jax.lax.scan(step, (zero, zero + UNKNOWN), (trajectory.rewards, trajectory.done_after))
    return max_return


# (outcome, with a ValueSummary and its solve rates; best_return [W]: R of the level of each world, this update's
# episodes included, UNKNOWN where none ended yet) -> [W] float32, UNKNOWN where nothing was seen
ReplayScore = Callable[[LevelOutcome, Array], Array]

REPLAY_SCORES: Registry[ReplayScore] = Registry("score of levels")


def _max_mc(outcome: LevelOutcome, best_return: Array) -> Array:
    return best_return - outcome.summary.mean_value


def _positive_value_loss(outcome: LevelOutcome, best_return: Array) -> Array:
    del best_return
    return outcome.summary.positive_value_loss


def _l1_value_loss(outcome: LevelOutcome, best_return: Array) -> Array:
    del best_return
    return outcome.summary.l1_value_loss


def _learnability(outcome: LevelOutcome, best_return: Array) -> Array:
    del best_return
    p = outcome.summary.solve_rate
    return jnp.where(p > UNKNOWN, p * (1.0 - p), UNKNOWN)


def _failure(outcome: LevelOutcome, best_return: Array) -> Array:
    del best_return
    p = outcome.summary.solve_rate
    return jnp.where(p > UNKNOWN, 1.0 - p, UNKNOWN)


REPLAY_SCORES.register("max_mc", _max_mc)
REPLAY_SCORES.register("positive_value_loss", _positive_value_loss)
REPLAY_SCORES.register("l1_value_loss", _l1_value_loss)
REPLAY_SCORES.register("learnability", _learnability)
REPLAY_SCORES.register("failure", _failure)
