"""Polishing of solutions: shorter ones that do not depend on the last digit of the start.

Variants of what was found are played, each from a slightly different start: a stretch left out, held, or replaced.
Those that solve the level go on, the more starts they solve it from the better, then the shorter the better. A solution
that only works from exactly one start says little, and may fail on another device, whose float32 rounds otherwise.
"""

from __future__ import annotations

import numpy as np

from kinetix_dist.evaluation.search.worlds import Budget, Worlds, solutions

ROUNDS = 8
NUM_CANDIDATES = 16  # solutions that are tried from other starts, a round; half as many are changed in the next
MAX_STRETCH = 32  # environment steps that a variant changes
ENOUGH = 0.97  # robustness beyond which shorter is better


def polish(
    worlds: Worlds, found: list[np.ndarray], rng: np.random.Generator, budget: Budget
) -> tuple[np.ndarray, float]:
    """The best of `found` and its variants, [t, 6], and its robustness.

    `found` are solutions from the start of the level, and so is what is returned.
    """
    starts = worlds.different_starts(rng)
    candidates = found[:NUM_CANDIDATES]
    best: list[tuple[np.ndarray, float]] = []
    for _ in range(ROUNDS):
        best += zip(candidates, robustness(worlds, starts, candidates, budget))
        best = sorted(best, key=lambda one: rank(*one), reverse=True)[: NUM_CANDIDATES // 2]
        if budget.is_spent:
            break
        candidates = _candidates(worlds, starts, [actions for actions, _ in best], rng, budget)
        if not candidates:
            break
    return best[0]


def rank(actions: np.ndarray, robustness: float) -> tuple[float, int]:
    """The better one is larger."""
    return min(robustness, ENOUGH), -len(actions)


def _candidates(
    worlds: Worlds, starts: object, parents: list[np.ndarray], rng: np.random.Generator, budget: Budget
) -> list[np.ndarray]:
    """Variants that solve the level from another start and from its own: the shortest, and some of the others."""
    variants = padded(worlds, [variant(rng, parents, worlds.actions) for _ in range(worlds.num_worlds)])
    solved_after = worlds.play(starts, variants, budget).solved_after
    solved = np.flatnonzero(solved_after)
    solved = solved[np.argsort(solved_after[solved], kind="stable")]
    half = NUM_CANDIDATES // 2
    chosen = np.concatenate([solved[:half], rng.permutation(solved[half:])[:half]])
    if len(chosen) == 0:
        return []
    again = variants[:, np.resize(chosen, worlds.num_worlds)]
    found = solutions(worlds.episodes(again, budget), again)
    return list({actions.tobytes(): actions for actions in found}.values())[:NUM_CANDIDATES]


def robustness(
    worlds: Worlds, starts: object, candidates: list[np.ndarray], budget: Budget | None = None
) -> list[float]:
    """Share of other starts (`Worlds.different_starts`) from which each of the candidates [t, 6] solves the level."""
    tries = worlds.num_worlds // len(candidates)
    repeated = [actions for actions in candidates for _ in range(tries)]
    repeated += [candidates[-1]] * (worlds.num_worlds - len(repeated))
    solved = worlds.play(starts, padded(worlds, repeated), budget).solved_after > 0
    return solved[: len(candidates) * tries].reshape(len(candidates), tries).mean(axis=1).tolist()


def padded(worlds: Worlds, sequences: list[np.ndarray]) -> np.ndarray:
    """[max_steps, W, 6]: sequences [t, 6], nothing done after their ends."""
    padded = np.zeros((worlds.max_steps, len(sequences), sequences[0].shape[1]), np.int32)
    for world, actions in enumerate(sequences):
        padded[: len(actions), world] = actions[: worlds.max_steps]
    return padded


def variant(rng: np.random.Generator, parents: list[np.ndarray], actions: np.ndarray) -> np.ndarray:
    """One of the parents with one stretch left out, replaced by one action, or by the action before it."""
    parent = parents[rng.integers(len(parents))]
    start = int(rng.integers(len(parent)))
    end = min(len(parent), start + 1 + int(rng.integers(MAX_STRETCH)))
    kind = rng.integers(3)
    if kind == 0:
        return np.concatenate([parent[:start], parent[end:]])
    held = parent[max(0, start - 1)] if kind == 1 else actions[rng.integers(len(actions))]
    return np.concatenate([parent[:start], np.tile(held, (end - start, 1)), parent[end:]])
