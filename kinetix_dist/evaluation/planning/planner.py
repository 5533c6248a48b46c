"""Planner: rounds of search for several problems at once, until each has a plan or no time.

    planner = Planner(env, player, size=PlannerSize(num_slots=8, num_worlds=2048))
    planner.warm_up(levels)                                      compiles; no part of the time of a plan
    attempts = planner.plan(problems, budget)                    one of each problem

Rounds follow one fixed pattern, so that what is found depends on the seed and the number of rounds alone; a budget in
seconds only says where they stop. A round is charged to the problems that are searched in it, in equal parts: eight
problems that share a device for 8 s have used 1 s each. The slots of a problem that has its plan go to the others.
"""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.planning.explore_round import explore_round
from kinetix_dist.evaluation.planning.held_round import held_round
from kinetix_dist.evaluation.planning.policy_round import policy_round
from kinetix_dist.evaluation.planning.problems import Candidates, Problems, problems_at
from kinetix_dist.evaluation.planning.ranking import ENOUGH, robustness
from kinetix_dist.evaluation.policies import NetworkPolicy, Player, first_memory
from kinetix_dist.level.level import Level

PATTERN = ("policy", "held", "explore", "held", "explore", "explore", "held", "explore", "explore")
MIN_WORLDS = 16  # of a problem: as many as there are candidates


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannerSize:
    """Worlds of one program."""

    num_slots: int  # problems at once
    num_worlds: int  # of each
    policy_share: int = 4  # a round of the policy has one world of so many: its steps cost most

    def __post_init__(self) -> None:
        if self.num_slots < 1:
            raise ValueError(f"{self.num_slots} problems at once cannot be searched; give 1 or more")
        if self.num_worlds < MIN_WORLDS:
            raise ValueError(f"{self.num_worlds} worlds are too few to search with; give {MIN_WORLDS} or more")


GPU_SIZE = PlannerSize(num_slots=8, num_worlds=2048)
# The policy takes 50 times as long as the engine there: 16 of its episodes take a second.
CPU_SIZE = PlannerSize(num_slots=1, num_worlds=256, policy_share=16)


def default_size() -> PlannerSize:
    return CPU_SIZE if jax.default_backend() == "cpu" else GPU_SIZE


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """Planning that each problem may take, in seconds or in rounds."""

    left: np.ndarray  # [N] float
    in_rounds: bool = False

    @classmethod
    def of(cls, num_problems: int, *, seconds: float | None = None, rounds: int | None = None) -> Budget:
        """Raises ValueError unless exactly one is given and more than 0."""
        given = [amount for amount in (seconds, rounds) if amount is not None]
        if len(given) != 1 or not 0 < given[0] < float("inf"):
            raise ValueError(f"a search takes seconds or rounds, more than 0; it has {seconds} s and {rounds} rounds")
        return cls(left=np.full(num_problems, float(given[0])), in_rounds=rounds is not None)

    def after(self, used: np.ndarray) -> Budget:
        return dataclasses.replace(self, left=np.maximum(0.0, self.left - used))

    def take(self, index: Sequence[int] | np.ndarray) -> Budget:
        return dataclasses.replace(self, left=self.left[np.asarray(index, int)])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """Result of the search for one problem."""

    actions: np.ndarray | None  # [t, ...] from its state, the last step solves; None where none was found
    used: float  # of the budget
    seconds: float  # the same in seconds
    rounds: int
    method: str = ""  # round that found it
    robustness: float = 0.0  # share of perturbed states that the same actions solve


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solution:
    """Actions that solve a problem."""

    actions: np.ndarray  # [t, ...]
    robustness: float

    def rank(self) -> tuple[float, int]:
        """The better one is larger."""
        return min(self.robustness, ENOUGH), -len(self.actions)


class Planner:
    """Searches with one policy in one environment. Raises ValueError for a policy with a memory."""

    def __init__(self, env: Environment, player: Player, *, size: PlannerSize, seed: int = 0) -> None:
        policy = player.policy
        if first_memory(policy, 1) is not None:
            raise ValueError("a policy with a memory cannot be planned with: a plan begins in the middle of episodes")
        if isinstance(policy, NetworkPolicy):
            policy = dataclasses.replace(policy, greedy=False)  # equal episodes search nothing
        self.env, self.player, self.size = env, Player(policy, player.params), size
        self.seed = seed
        self._key = prng.key(seed)

    def warm_up(self, levels: Level) -> float:
        """Compiles every program for levels [N, ...] like these; returns the seconds that it took."""
        begin = time.monotonic()
        one = jax.tree.map(lambda x: jnp.asarray(x)[:1], levels)
        prepared = self.env.prepare(one)
        problems = problems_at(self.env, one, prepared.initial_packed_state, jnp.zeros(1, jnp.int32))
        problems = _padded(problems, np.zeros(1, int), self.size.num_slots)
        slots = jnp.zeros(self.size.num_slots, jnp.int32)
        first, *others = dict.fromkeys(PATTERN)
        problems, candidates = self._round(first, problems, slots, self._key)
        for method in others:
            problems, candidates = self._round(method, problems, slots, self._key)
        jax.block_until_ready(self._rank(problems, slots, candidates, self._key))
        return time.monotonic() - begin

    def plan(
        self, problems: Problems, budget: Budget, on_plans: Callable[[list[Plan]], None] = lambda plans: None
    ) -> list[Plan]:
        """Plans for problems [N, ...], `num_slots` of them at once; on_plans is called with those so far."""
        return self._plan(problems, budget, np.arange(len(budget.left)), PATTERN.index("policy"), on_plans)

    def replan(self, problems: Problems, budget: Budget, index: np.ndarray) -> list[Plan]:
        """Plans for some of the problems, which have old plans as bases: variants of these are tried first."""
        return self._plan(problems, budget, index, PATTERN.index("held"), lambda plans: None)

    def _plan(
        self,
        problems: Problems,
        budget: Budget,
        index: np.ndarray,
        first_turn: int,
        on_plans: Callable[[list[Plan]], None],
    ) -> list[Plan]:
        plans: list[Plan] = []
        for start in range(0, len(index), self.size.num_slots):
            some = index[start : start + self.size.num_slots]
            chosen = jax.block_until_ready(_padded(problems, some, self.size.num_slots))
            plans += self._plan_some(chosen, budget.take(some), prng.fold_in(self._key, start), first_turn)
            on_plans(plans)
        return plans

    def _plan_some(self, problems: Problems, budget: Budget, key: Array, first_turn: int) -> list[Plan]:
        """Plans for the first problems of `num_slots`, as many as have a budget. The key is consumed."""
        number, num_slots = len(budget.left), self.size.num_slots
        used, seconds, rounds = np.zeros(number), np.zeros(number), np.zeros(number, int)
        plans: dict[int, Plan] = {}
        for turn in itertools.count(first_turn):
            active = [i for i in range(number) if i not in plans and used[i] < budget.left[i]]
            if not active:
                break
            begin = time.monotonic()
            slot_of = np.resize(active, num_slots)
            slots, method = jnp.asarray(slot_of, jnp.int32), PATTERN[turn % len(PATTERN)]
            round_key, rank_key = prng.split(prng.fold_in(key, turn))
            problems, candidates = self._round(method, problems, slots, round_key)
            found = self._best(problems, slots, candidates, rank_key)
            share = (time.monotonic() - begin) / len(active)
            seconds[active] += share
            rounds[active] += 1
            used[active] += 1 if budget.in_rounds else share
            for i in active:
                solutions = [found[slot] for slot in np.flatnonzero(slot_of == i) if slot in found]
                if solutions and used[i] <= budget.left[i]:  # what comes too late does not count
                    best = max(solutions, key=Solution.rank)
                    plans[i] = Plan(
                        actions=best.actions,
                        used=float(used[i]),
                        seconds=float(seconds[i]),
                        rounds=int(rounds[i]),
                        method=method,
                        robustness=best.robustness,
                    )
        return [
            plans.get(i, Plan(actions=None, used=float(used[i]), seconds=float(seconds[i]), rounds=int(rounds[i])))
            for i in range(number)
        ]

    def _best(self, problems: Problems, slots: Array, candidates: Candidates, key: Array) -> dict[int, Solution]:
        """Best solution of each slot that has any."""
        solved_after = np.asarray(candidates.solved_after)
        if not solved_after.any():
            return {}
        shares, actions = np.asarray(self._rank(problems, slots, candidates, key)), np.asarray(candidates.actions)
        best = {}
        for slot in np.flatnonzero(solved_after.any(axis=1)):
            solutions = [
                Solution(robustness=float(shares[slot, i]), actions=actions[: solved_after[slot, i], slot, i])
                for i in np.flatnonzero(solved_after[slot])
            ]
            best[int(slot)] = max(solutions, key=Solution.rank)
        return best

    def _rank(self, problems: Problems, slots: Array, candidates: Candidates, key: Array) -> Array:
        return robustness(self.env, problems, slots, candidates, key, self.size.num_worlds)

    def _round(self, method: str, problems: Problems, slots: Array, key: Array) -> tuple[Problems, Candidates]:
        env, (policy, params), num_worlds = self.env, self.player, self.size.num_worlds
        if method == "held":
            return held_round(env, problems, slots, key, num_worlds)
        if method == "explore":
            return explore_round(env, policy, params, problems, slots, key, num_worlds)
        few = max(MIN_WORLDS, num_worlds // self.size.policy_share)
        return policy_round(env, policy, params, problems, slots, key, few)


def _padded(problems: Problems, index: np.ndarray, number: int) -> Problems:
    """`number` problems: those of `index`, and its first one again after the last."""
    padding = np.full(number - len(index), index[0])
    return _take(problems, jnp.asarray(np.concatenate([index, padding]), jnp.int32))


@jax.jit
def _take(problems: Problems, index: Array) -> Problems:
    return problems.take(index)
