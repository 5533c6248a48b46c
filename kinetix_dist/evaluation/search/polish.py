"""Of a found solution a shorter one, and one that does not depend on the last digit of the start.

Variants of what was found are played: a stretch left out, held, or replaced. Those that solve the level go on, the
shorter the better; some of them are played from slightly different starts. A solution that only works from exactly one
start says little, and may fail on another device, whose float32 rounds otherwise.
"""

from __future__ import annotations

import numpy as np

from kinetix_dist.evaluation.search.worlds import Budget, Worlds, solutions

ROUNDS = 8
NUM_PARENTS = 16  # solutions that variants are made of, and that are tried from other starts, a round
MAX_STRETCH = 32  # environment steps that a variant changes
ENOUGH = 0.97  # robustness beyond which shorter is better


def polish(
    worlds: Worlds, found: list[np.ndarray], rng: np.random.Generator, budget: Budget
) -> tuple[np.ndarray, float]:
    """The best of `found` and its variants, [t, 6], and its robustness: the share of other starts that it solves."""
    starts = worlds.different_starts(rng)
    best, best_robustness = found[0], -1.0
    parents = found[:NUM_PARENTS]
    for _ in range(ROUNDS):
        for actions, robustness in zip(parents, _robustness(worlds, starts, parents, budget)):
            if _rank(actions, robustness) > _rank(best, best_robustness):
                best, best_robustness = actions, robustness
        if budget.is_spent:
            break
        variants = [best, *parents, *(_variant(rng, parents, worlds.actions) for _ in range(worlds.num_worlds))]
        padded = _padded(worlds, variants[: worlds.num_worlds])
        solved = solutions(worlds.episodes(padded, budget), padded)
        # The shortest, and as many of the others: a longer way may be the more robust one.
        half = NUM_PARENTS // 2
        others = rng.permutation(len(solved) - half)[:half] + half if len(solved) > half else []
        parents = [*solved[:half], *(solved[i] for i in others)]
    return best, best_robustness


def _rank(actions: np.ndarray, robustness: float) -> tuple[float, int]:
    return min(robustness, ENOUGH), -len(actions)


def _robustness(worlds: Worlds, starts: object, candidates: list[np.ndarray], budget: Budget) -> list[float]:
    """Share of other starts from which each of the candidates solves the level."""
    tries = worlds.num_worlds // len(candidates)
    repeated = [actions for actions in candidates for _ in range(tries)]
    repeated += [candidates[-1]] * (worlds.num_worlds - len(repeated))
    solved = worlds.play(starts, _padded(worlds, repeated), budget).solved_after > 0
    return solved[: len(candidates) * tries].reshape(len(candidates), tries).mean(axis=1).tolist()


def _padded(worlds: Worlds, sequences: list[np.ndarray]) -> np.ndarray:
    """[max_steps, W, 6]: sequences [t, 6], nothing done after their ends."""
    padded = np.zeros((worlds.max_steps, len(sequences), worlds.actions.shape[1]), np.int32)
    for world, actions in enumerate(sequences):
        padded[: len(actions), world] = actions[: worlds.max_steps]
    return padded


def _variant(rng: np.random.Generator, parents: list[np.ndarray], actions: np.ndarray) -> np.ndarray:
    """One of the parents with one stretch left out, replaced by one action, or by the action before it."""
    parent = parents[rng.integers(len(parents))]
    start = int(rng.integers(len(parent)))
    end = min(len(parent), start + 1 + int(rng.integers(MAX_STRETCH)))
    kind = rng.integers(3)
    if kind == 0:
        return np.concatenate([parent[:start], parent[end:]])
    held = parent[max(0, start - 1)] if kind == 1 else actions[rng.integers(len(actions))]
    return np.concatenate([parent[:start], np.tile(held, (end - start, 1)), parent[end:]])
