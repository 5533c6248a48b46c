"""Sampled actions of a trained policy: whole episodes from the start, as an evaluation plays them."""

from __future__ import annotations

import numpy as np

from kinetix_dist import prng
from kinetix_dist.evaluation.policies import Player
from kinetix_dist.evaluation.recordings import play_policy
from kinetix_dist.evaluation.search.worlds import Budget, Worlds, solutions


def policy_search(worlds: Worlds, player: Player, rng: np.random.Generator, budget: Budget) -> list[np.ndarray]:
    """Solutions [t, 6] of the first batch of episodes that has any; none where time ran out first."""
    while not budget.is_spent:
        key = prng.key(int(rng.integers(2**31)))
        actions = play_policy(worlds.env, player, worlds.prepared, key)
        found = solutions(worlds.episodes(actions, budget), actions)
        if found:
            return found
    return []
