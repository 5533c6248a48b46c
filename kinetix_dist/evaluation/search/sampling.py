"""Searches that sample whole episodes: random actions, actions of a policy, variants of a stored solution."""

from __future__ import annotations

import numpy as np

from kinetix_dist import prng
from kinetix_dist.evaluation.policies import Player
from kinetix_dist.evaluation.recordings import play_policy
from kinetix_dist.evaluation.search.polish import padded, variant
from kinetix_dist.evaluation.search.worlds import Budget, Worlds, solutions

MIN_HOLD, MAX_HOLD = 2, 64  # environment steps; how long an episode holds its actions on average is drawn between them
POLICY_WORLDS = 64  # at once: on a CPU their episodes take seconds, those of 512 worlds a share of a minute


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


def policy_search(worlds: Worlds, player: Player, rng: np.random.Generator, budget: Budget) -> list[np.ndarray]:
    """Solutions [t, 6] of the first batch of episodes that has any; none where time ran out first.

    One batch is played even where compiling took all the time.
    """
    worlds = Worlds(worlds.env, worlds.level, min(POLICY_WORLDS, worlds.num_worlds))
    while True:
        key = prng.key(int(rng.integers(2**31)))
        actions = play_policy(worlds.env, player, worlds.prepared, key)
        found = solutions(worlds.episodes(actions, budget), actions)
        if found or budget.is_spent:
            return found


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
