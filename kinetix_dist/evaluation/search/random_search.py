"""Random actions, each held for a while: whole episodes from the start."""

from __future__ import annotations

import numpy as np

from kinetix_dist.evaluation.search.worlds import Budget, Worlds, solutions

MIN_HOLD, MAX_HOLD = 2, 64  # environment steps; how long a world holds its actions on average is drawn between them


def random_search(worlds: Worlds, rng: np.random.Generator, budget: Budget) -> list[np.ndarray]:
    """Solutions [t, 6] of the first batch of episodes that has any; none where time ran out first."""
    while not budget.is_spent:
        actions = worlds.actions[held_choices(rng, worlds.max_steps, worlds.num_worlds, len(worlds.actions))]
        found = solutions(worlds.episodes(actions, budget), actions)
        if found:
            return found
    return []


def held_choices(rng: np.random.Generator, num_steps: int, num_worlds: int, num_choices: int) -> np.ndarray:
    """[T, W] int: choices that change at random moments, in some worlds often and in some seldom."""
    hold = np.exp(rng.uniform(np.log(MIN_HOLD), np.log(MAX_HOLD), num_worlds))
    changes = rng.random((num_steps, num_worlds)) < 1.0 / hold
    changes[0] = True
    drawn = rng.integers(num_choices, size=(num_steps, num_worlds))
    last_change = np.maximum.accumulate(np.where(changes, np.arange(num_steps)[:, None], 0), axis=0)
    return np.take_along_axis(drawn, last_change, axis=0)
