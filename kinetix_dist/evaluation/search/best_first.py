"""Best-first search over stored states: go on from where green came close to blue, and from where few went on.

An archive keeps one state of each cell, a coarse description of where things are and how fast green moves. Half of
the worlds go on from states near the goal, half from seldom used ones; random actions are held for one or two blocks;
new cells are added. (Ecoffet et al., Go-Explore, 2019, with the distance of green and blue as what is promising.)
"""

from __future__ import annotations

import jax
import numpy as np

from kinetix_dist.evaluation.search.worlds import Budget, Played, Worlds

SEGMENT_STEPS = 8  # environment steps from a stored state to the next
GREEN_CELL_M = 0.15
OTHER_CELL_M = 0.4
SPEED_CELL_M_S = 1.0
ANGLE_CELL_RAD = np.pi / 3
NEARNESS_M = 0.4  # how much farther from blue halves the chance of a state, about
MAX_STORED = 40_000  # states, at most 1.7 kB each


def best_first(worlds: Worlds, rng: np.random.Generator, budget: Budget) -> list[np.ndarray]:
    """The solutions [t, 6] of the first segment that has any; none where time ran out first."""
    archive = Archive(worlds)
    while not budget.is_spent:
        origin = archive.choose(rng, worlds.num_worlds)
        actions = _segment(worlds, rng)
        played = worlds.play(archive.states(origin), actions, budget)
        found = [
            np.concatenate([archive.path(origin[world]), actions[: played.solved_after[world], world]])
            for world in np.flatnonzero(played.solved_after)
        ]
        if found:
            return sorted(found, key=len)
        archive.add(origin, actions, played)
    return []


def _segment(worlds: Worlds, rng: np.random.Generator) -> np.ndarray:
    """[SEGMENT_STEPS, W, 6]: one action, or one and then another."""
    choices = rng.integers(len(worlds.actions), size=(2, worlds.num_worlds))
    change = rng.choice([SEGMENT_STEPS // 2, SEGMENT_STEPS], worlds.num_worlds)
    return worlds.actions[np.where(np.arange(SEGMENT_STEPS)[:, None] < change, choices[0], choices[1])]


class Archive:
    """Stored states by cell, each with how it was reached. Full, it only takes shorter ways to the cells it has."""

    def __init__(self, worlds: Worlds) -> None:
        self._worlds = worlds
        leaves, self._tree = jax.tree.flatten(jax.device_get(worlds.start))
        self._stored = [np.zeros((MAX_STORED, leaf.shape[0]), leaf.dtype) for leaf in leaves]
        for stored, leaf in zip(self._stored, leaves):
            stored[0] = leaf[:, 0]
        self._distance = np.zeros(MAX_STORED)
        self._distance[0] = float(worlds.prepared.initial_distance[0])
        self._visits = np.zeros(MAX_STORED)
        self._paths: list[tuple[np.ndarray, ...]] = [()]  # segments [SEGMENT_STEPS, 6] that lead to each
        self._slot_of: dict[bytes, int] = {}

    def choose(self, rng: np.random.Generator, number: int) -> np.ndarray:
        """[number] int: stored states to go on from."""
        stored = len(self._paths)
        steps = np.array([len(path) for path in self._paths]) * SEGMENT_STEPS
        may_go_on = steps + SEGMENT_STEPS <= self._worlds.max_steps
        seldom = may_go_on / (1.0 + self._visits[:stored]) ** 2
        nearest = self._distance[:stored][may_go_on].min()
        near = may_go_on * np.exp(-(self._distance[:stored] - nearest) / NEARNESS_M) / (1.0 + self._visits[:stored])
        origin = np.concatenate(
            [
                rng.choice(stored, number // 2, p=near / near.sum()),
                rng.choice(stored, number - number // 2, p=seldom / seldom.sum()),
            ]
        )
        np.add.at(self._visits, origin, 1.0)
        return origin

    def states(self, origin: np.ndarray) -> object:
        """The packed state of each world."""
        return jax.tree.unflatten(self._tree, [stored[origin].T for stored in self._stored])

    def path(self, slot: int) -> np.ndarray:
        """[t, 6]: the actions from the start to a stored state."""
        return np.concatenate([np.zeros((0, self._worlds.actions.shape[1]), np.int32), *self._paths[slot]])

    def add(self, origin: np.ndarray, actions: np.ndarray, played: Played) -> None:
        leaves = jax.tree.leaves(played.packed_state)
        ways = [self._paths[slot] for slot in origin]  # before any of these slots gets another state
        for world, cell in enumerate(self._cells(played)):
            if played.is_over[world]:
                continue
            path = (*ways[world], actions[:, world])
            slot = self._slot_of.get(cell, len(self._paths))
            if slot == MAX_STORED or (slot < len(self._paths) and len(self._paths[slot]) <= len(path)):
                continue
            if slot == len(self._paths):
                self._slot_of[cell] = slot
                self._paths.append(path)
            else:
                self._paths[slot] = path
            for stored, leaf in zip(self._stored, leaves):
                stored[slot] = leaf[:, world]
            self._distance[slot] = played.distance[world]

    def _cells(self, played: Played) -> list[bytes]:
        green = self._worlds.green
        others = played.position[:, self._worlds.movable]
        described = np.concatenate(
            [
                played.position[:, green] / GREEN_CELL_M,
                played.velocity[:, green] / SPEED_CELL_M_S,
                (played.angle[:, green, None] % (2 * np.pi)) / ANGLE_CELL_RAD,
                others.reshape(len(others), -1) / OTHER_CELL_M,
            ],
            axis=1,
        )
        finite = np.nan_to_num(described, nan=0.0, posinf=1e4, neginf=-1e4)  # worlds that are over are not stored
        return [row.tobytes() for row in np.rint(finite).astype(np.int16)]
