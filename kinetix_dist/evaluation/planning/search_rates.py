"""Solve rates with planning: of the levels as they are, against the time of planning, and from perturbed starts.

    result = search_rates(env, player, levels, names, SearchOptions(seconds=10.0))
    result.rate, result.alone, result.at(2.0), result.starts

Kept apart from the rates of `evaluate`: a plan is made by trying, so the share with search is no zero-shot rate.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import index_worlds
from kinetix_dist import prng
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.evaluate import Episodes, SolveRates, solve_rate
from kinetix_dist.evaluation.planning.execution import Executed, execute, problems_of
from kinetix_dist.evaluation.planning.planner import Budget, Plan, Planner, PlannerSize
from kinetix_dist.evaluation.planning.ranking import perturbed
from kinetix_dist.evaluation.policies import Player
from kinetix_dist.level.level import Level

MOMENTS = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # of the curve, in units of the budget

STARTS = 0x53544152  # "STAR": key of perturbed starts


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchOptions:
    """Budget of a search and its size. Either seconds or rounds are given."""

    seconds: float | None = None
    rounds: int | None = None
    size: PlannerSize
    num_starts: int = 4  # perturbed starts of each level
    seed: int = 0

    @property
    def unit(self) -> str:
        return "s" if self.seconds is not None else "rounds"

    def budget(self, num_levels: int) -> Budget:
        return Budget.of(num_levels, seconds=self.seconds, rounds=self.rounds)


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchRates:
    """Solve rates of one search over a set of levels."""

    options: SearchOptions
    alone: SolveRates  # what the policy does without a plan, one attempt a level
    rate: SolveRates  # plans executed from the starts of the levels, one attempt a level
    starts: SolveRates | None  # from perturbed starts, `num_starts` attempts a level
    plans: tuple[Plan, ...]  # of each level
    replans: np.ndarray  # [L, num_starts] int
    num_unconfirmed: int  # executions that the environment does not confirm, which do not count as solved
    compile_seconds: float
    search_seconds: float  # wall time of planning, without replans

    @property
    def moments(self) -> list[float]:
        """Budgets of which `at` is reported."""
        whole = float(self.options.budget(1).left[0])
        return [moment for moment in MOMENTS if moment < whole] + [whole]

    def at(self, amount: float) -> float:
        """Solve rate with that much of the budget: where no plan was found by then, what the policy does counts."""
        return float(np.mean([self._is_solved(i, amount) for i in range(len(self.plans))]))

    def _is_solved(self, i: int, amount: float) -> bool:
        has_plan = self.plans[i].actions is not None and self.plans[i].used <= amount
        return bool((self.rate if has_plan else self.alone).levels[i].solved)

    def to_dict(self, base_levels: Sequence[str]) -> dict[str, Any]:
        """Values for JSON."""
        rates = {"policy_alone": self.alone, "with_search": self.rate, "perturbed_starts": self.starts}
        return {
            "seconds": self.options.seconds,
            "rounds": self.options.rounds,
            "levels_at_once": self.options.size.num_slots,
            "worlds_per_level": self.options.size.num_worlds,
            "compile_seconds": self.compile_seconds,
            "search_seconds": self.search_seconds,
            "unconfirmed": self.num_unconfirmed,
            "solve_rate": {
                name: rates.to_dict(per_level=False) | {"interval_over_levels": rates.over_levels(base_levels)}
                for name, rates in rates.items()
                if rates is not None
            },
            "rate_after": [{"budget": moment, "rate": self.at(moment)} for moment in self.moments],
            "levels": [self._level(i) for i in range(len(self.plans))],
        }

    def _level(self, i: int) -> dict[str, Any]:
        plan = self.plans[i]
        has_plan = plan.actions is not None
        return {
            "name": self.rate.levels[i].name,
            "policy_alone": bool(self.alone.levels[i].solved),
            "solved": bool(self.rate.levels[i].solved),
            "found_after_seconds": plan.seconds if has_plan else None,
            "rounds": plan.rounds,
            "method": plan.method if has_plan else None,
            "plan_steps": len(plan.actions) if plan.actions is not None else None,
            "robustness": plan.robustness if has_plan else None,
            "perturbed_starts": None if self.starts is None else self.starts.levels[i].rate,
            "replans": int(self.replans[i].sum()),
        }


def search_rates(
    env: Environment,
    player: Player,
    levels: Level,
    names: Sequence[str],
    options: SearchOptions,
    on_plans: Callable[[list[Plan]], None] = lambda plans: None,
) -> SearchRates:
    """Plans for each level of a batch [L, ...] and executes the plans. on_plans is called with the plans so far.

    Raises ValueError for a policy with a memory and for a budget that is none. Compiles once for each (env, policy,
    size), and for each number of levels that are executed.
    """
    number = len(names)
    budget = options.budget(number)
    planner = Planner(env, player, size=options.size, seed=options.seed)
    levels = jax.tree.map(jnp.asarray, levels)
    compile_seconds = planner.warm_up(levels)
    key = prng.key(options.seed)
    begin = time.monotonic()
    plans = planner.plan(problems_of(env, levels), budget, on_plans)
    search_seconds = time.monotonic() - begin
    left = budget.after(np.array([plan.used for plan in plans]))
    none = [dataclasses.replace(plan, actions=None) for plan in plans]
    alone = execute(planner, player, (levels, levels), none, left, key)
    planned = execute(planner, player, (levels, levels), plans, left, key)
    parts, starts, replans = [planned], None, np.zeros((number, 0), int)
    if options.num_starts:
        moved = _from_perturbed_starts(planner, player, levels, plans, left, options.num_starts)
        starts, replans = _rates(names, moved.episodes), moved.num_replans.reshape(number, -1)
        parts.append(moved)
    return SearchRates(
        options=options,
        alone=_rates(names, alone.episodes),
        rate=_rates(names, planned.episodes),
        starts=starts,
        plans=tuple(plans),
        replans=replans,
        num_unconfirmed=sum(int((~part.was_confirmed).sum()) for part in parts),
        compile_seconds=compile_seconds,
        search_seconds=search_seconds,
    )


def _from_perturbed_starts(
    planner: Planner, player: Player, levels: Level, plans: Sequence[Plan], left: Budget, num_starts: int
) -> Executed:
    """Executions from `num_starts` starts of each level, level by level."""
    index = np.repeat(np.arange(len(plans)), num_starts)
    planned = index_worlds(levels, index)
    start_key, act_key = prng.split(prng.fold_in(prng.key(planner.seed), STARTS))
    true = perturbed(planned, start_key)
    return execute(planner, player, (planned, true), [plans[i] for i in index.tolist()], left.take(index), act_key)


def _rates(names: Sequence[str], episodes: Episodes) -> SolveRates:
    """Solve rates of as many episodes of each level, level by level."""
    by_level = jax.tree.map(lambda x: x.reshape(len(names), -1), episodes)
    return SolveRates(
        total=solve_rate("all", by_level),
        levels=tuple(solve_rate(name, index_worlds(by_level, i)) for i, name in enumerate(names)),
    )
