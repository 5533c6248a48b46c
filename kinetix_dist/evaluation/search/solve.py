"""Finds a proof for a level: the methods one after the other, then the environment replays what was found.

outcome = solve(env, Target(name=name, level=level, document=document), seconds=60)
outcome.proof, or None and outcome.tried, a line for each method
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from kinetix_dist.env.env_config import describe
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.policies import Player
from kinetix_dist.evaluation.proofs import replay
from kinetix_dist.evaluation.search.best_first import best_first
from kinetix_dist.evaluation.search.cross_entropy import cross_entropy
from kinetix_dist.evaluation.search.polish import polish, rank, robustness
from kinetix_dist.evaluation.search.sampling import from_stored, policy_search, random_search
from kinetix_dist.evaluation.search.worlds import Budget, Worlds, useful_actions
from kinetix_dist.level.level import Level
from kinetix_dist.level.proof import Proof, level_hash

POLISH_SHARE = 0.25  # of the seconds, once something was found
ROBUST = 0.9  # a solution that works from fewer of slightly different starts counts, but the search goes on

Search = Callable[[Worlds, np.random.Generator, Budget], list[np.ndarray]]
SEARCHES: dict[str, Search] = {"random": random_search, "cem": cross_entropy, "best_first": best_first}
METHODS = (*SEARCHES, "stored", "policy")
SHARES = {
    "policy": 0.15,
    "stored": 0.3,
    "random": 0.15,
    "cem": 0.35,
    "best_first": 1.0,
}  # of the seconds that are left, in this order


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solved:
    """Result of a search: a proof, or why there is none."""

    proof: Proof | None
    tried: tuple[str, ...]  # a line for each method, in the order tried


@dataclasses.dataclass(frozen=True, kw_only=True)
class Target:
    """Level to solve, and policy or actions to begin with."""

    name: str
    level: Level  # numpy, of the environment's size
    document: dict[str, Any]  # that describes it
    player: Player | None = None  # for method "policy"
    stored: np.ndarray | None = None  # [t, 6] actions that solve it or did so once, for method "stored"


def solve(
    env: Environment,
    target: Target,
    *,
    seconds: float,
    methods: Sequence[str] | None = None,
    num_worlds: int = 512,
    seed: int = 0,
) -> Solved:
    """Searches for actions that solve a level.

    methods: of METHODS, by default all that the target allows. Raises ValueError for a level in which
    no action moves anything, for an environment of other actions than multi-discrete ones and for unknown methods.
    """
    if env.action_space.name != "multi_discrete":
        raise ValueError(f"proofs are multi-discrete actions; the environment has {env.action_space.name!r}")
    searches = dict(SEARCHES)
    if target.player is not None:
        searches["policy"] = functools.partial(_with_policy, target.player)
    if target.stored is not None and len(target.stored):
        searches["stored"] = functools.partial(from_stored, target.stored)
    methods = tuple(searches) if methods is None else methods
    missing = [method for method in methods if method not in searches]
    if missing or not methods:
        raise ValueError(
            f"methods are {list(methods)}; choose of {', '.join(searches)} (policy needs a player, stored a proof)"
        )
    useful_actions(target.level)  # raises before anything is compiled
    worlds = Worlds(env, target.level, num_worlds)
    rng = np.random.default_rng(seed)
    methods = [method for method in SHARES if method in methods]
    whole = Budget(seconds)
    tried = []
    best: tuple[np.ndarray, float, str] | None = None  # actions, robustness, method
    for method in methods:
        if whole.is_spent:
            break
        is_last = method == methods[-1]
        budget = Budget(whole.seconds_left * (1.0 if is_last else SHARES[method]))
        found = searches[method](worlds, rng, budget)
        tried.append(f"{method}: {budget.num_steps:,} steps, green came within {budget.min_gap:.2f} m of blue")
        if found:
            actions, _ = polish(worlds, found, rng, Budget(POLISH_SHARE * seconds))
            # From starts of their own: from those by which the best was chosen, it looks better than it is.
            [share] = robustness(worlds, worlds.different_starts(rng), [actions])
            if best is None or rank(actions, share) > rank(*best[:2]):
                best = actions, share, method
            if share >= ROBUST:
                break
    if best is None:
        return Solved(proof=None, tried=tuple(tried))
    actions, share, method = best
    proof = Proof(
        level=target.name,
        level_sha256=level_hash(target.document),
        preset=describe(env.config.physics),
        frame_skip=env.config.frame_skip,
        max_steps=env.config.max_steps,
        action_space=env.action_space.name,
        actions=actions,
        method=method,
        robustness=round(share, 3),
    )
    rollout = replay(env, [target.level], [proof])[0]
    if not (rollout.solved and rollout.num_steps == proof.num_steps):
        raise RuntimeError(
            f"{target.name}: {method} found {proof.num_steps} steps that the environment does not confirm "
            f"({rollout.outcome} after {rollout.num_steps}): search and environment disagree, which is a bug"
        )
    return Solved(proof=proof, tried=tuple(tried))


def _with_policy(player: Player, worlds: Worlds, rng: np.random.Generator, budget: Budget) -> list[np.ndarray]:
    return policy_search(worlds, player, rng, budget)
