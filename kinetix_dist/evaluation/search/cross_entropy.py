"""Cross-entropy method over action sequences: draw episodes, keep the best, draw the next ones like them.

A sequence is blocks of equal length, in each of them one of the useful actions, drawn from a distribution of its own.
The best are those in which green came closest to blue. (Rubinstein, The cross-entropy method for combinatorial and
continuous optimization, 1999.) A distribution that no longer gets better is given up for a fresh one.
"""

from __future__ import annotations

import numpy as np

from kinetix_dist.evaluation.search.worlds import Budget, Worlds, solutions

BLOCK_STEPS = (8, 16, 4, 32)  # environment steps an action is held; one after the other, from restart to restart
ELITE_SHARE = 0.06
LEARNING_RATE = 0.6  # weight of the elite in the next distribution
UNIFORM_SHARE = 0.05  # of every distribution, so that no action dies out
PATIENCE = 10  # rounds without progress
MIN_PROGRESS_M = 0.01
RED_COST_M = 0.5  # what an episode that ends on red loses against one that does not


def cross_entropy(worlds: Worlds, rng: np.random.Generator, budget: Budget) -> list[np.ndarray]:
    """Solutions [t, 6] of the first round that has any; none where time ran out first."""
    restart = 0
    while not budget.is_spent:
        found = _one_distribution(worlds, rng, budget, BLOCK_STEPS[restart % len(BLOCK_STEPS)])
        if found:
            return found
        restart += 1
    return []


def _one_distribution(worlds: Worlds, rng: np.random.Generator, budget: Budget, hold: int) -> list[np.ndarray]:
    num_choices = len(worlds.actions)
    num_blocks = -(-worlds.max_steps // hold)
    chances = np.full((num_blocks, num_choices), 1.0 / num_choices)
    best, since_best = np.inf, 0
    while since_best < PATIENCE and not budget.is_spent:
        choices = _draw(rng, chances, worlds.num_worlds)
        actions = worlds.actions[np.repeat(choices, hold, axis=0)[: worlds.max_steps]]
        played = worlds.episodes(actions, budget)
        found = solutions(played, actions)
        if found:
            return found
        cost = played.min_distance + RED_COST_M * played.is_over
        elite = np.argsort(cost, kind="stable")[: max(2, int(ELITE_SHARE * worlds.num_worlds))]
        shares = np.eye(num_choices)[choices[:, elite]].mean(axis=1)
        chances = (1.0 - LEARNING_RATE) * chances + LEARNING_RATE * shares
        chances = (1.0 - UNIFORM_SHARE) * chances + UNIFORM_SHARE / num_choices
        since_best = 0 if cost.min() < best - MIN_PROGRESS_M else since_best + 1
        best = min(best, float(cost.min()))
    return []


def _draw(rng: np.random.Generator, chances: np.ndarray, num_worlds: int) -> np.ndarray:
    """[B, W] int: of each block a choice with the chances [B, K]."""
    ends = np.cumsum(chances, axis=1)
    drawn = rng.random((len(chances), num_worlds)) * ends[:, -1:]
    return np.minimum((drawn[:, :, None] >= ends[:, None, :]).sum(axis=2), chances.shape[1] - 1)
