"""Variants of actions that solved the level before, or nearly do: with another version of the engine, say."""

from __future__ import annotations

import numpy as np

from kinetix_dist.evaluation.search.polish import padded, variant
from kinetix_dist.evaluation.search.worlds import Budget, Worlds, solutions

MAX_CHANGES = 3  # stretches that differ from the parent, at most
NUM_PARENTS = 32


def from_stored(stored: np.ndarray, worlds: Worlds, rng: np.random.Generator, budget: Budget) -> list[np.ndarray]:
    """Solutions [t, 6] of the first batch that has any, among them `stored` [t, 6] if it still is one; none where time
    ran out first. Those that came nearest are changed next."""
    parents = [stored]
    while not budget.is_spent:
        tried = [*parents, *(_changed(rng, parents, worlds.actions) for _ in range(worlds.num_worlds - len(parents)))]
        actions = padded(worlds, tried)
        played = worlds.episodes(actions, budget)
        if found := solutions(played, actions):
            return found
        parents = [tried[world] for world in np.argsort(played.min_distance, kind="stable")[:NUM_PARENTS]]
    return []


def _changed(rng: np.random.Generator, parents: list[np.ndarray], actions: np.ndarray) -> np.ndarray:
    changed = variant(rng, parents, actions)
    for _ in range(rng.integers(MAX_CHANGES)):
        if len(changed):
            changed = variant(rng, [changed], actions)
    return changed
