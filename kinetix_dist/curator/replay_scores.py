"""What Prioritized Level Replay ranks levels by, `curriculum.plr.score`: a function of what an update saw of a level.

| name | score of a level |
|---|---|
| `learnability` | p (1 - p), p = solved / finished episodes |
| `failure` | 1 - p: levels that are never solved come first |
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.curator.scores import learnability, solve_rate
from kinetix_dist.messages import LevelOutcome
from kinetix_dist.registry import Registry

UNKNOWN = -jnp.inf  # the score of a level of which nothing is known: below all others

ReplayScore = Callable[[LevelOutcome], Array]  # -> [W] float32, UNKNOWN where the update showed nothing

REPLAY_SCORES: Registry[ReplayScore] = Registry("score of levels")


def _learnability(outcome: LevelOutcome) -> Array:
    return jnp.where(outcome.num_finished > 0, learnability(outcome.num_solved, outcome.num_finished), UNKNOWN)


def _failure(outcome: LevelOutcome) -> Array:
    return jnp.where(outcome.num_finished > 0, 1.0 - solve_rate(outcome.num_solved, outcome.num_finished), UNKNOWN)


REPLAY_SCORES.register("learnability", _learnability)
REPLAY_SCORES.register("failure", _failure)
