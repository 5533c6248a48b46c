"""Chooses the levels of the sets `frontier_s|m|l`, to be run once, with policies of several recipes.

    python -m bench.frontier_sets --policies generalist runs/s runs/m --json levels/frontier_sets.json

Levels of a stream are played in its order. One is chosen when random actions solve it in fewer than 20 % of 64
attempts, doing nothing does not solve it, and at least one of the policies solves it in 64 attempts. A size ends at
512 levels, or when 20,000 were played. Sizes in the file stay as they are.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np

from bench.program import exit_code, parser_of
from jax2d.scene import index_worlds
from kinetix_dist import prng
from kinetix_dist.atomic_files import replace_file
from kinetix_dist.env.environment import EnvConfig, Environment
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.evaluation.evaluate import evaluate
from kinetix_dist.evaluation.policies import Player, RandomPolicy
from kinetix_dist.finetune.specialists import policy_at
from kinetix_dist.level.fingerprints import fingerprint
from kinetix_dist.level.frontier import (
    MAX_RANDOM_RATE,
    FrontierSet,
    frontier_levels,
    frontier_text,
    read_frontier_sets,
    stream_levels,
)
from kinetix_dist.level.level import SIZES, Level
from kinetix_dist.level.simulation import noop_solved
from kinetix_dist.program_cache import enable_compile_cache
from kinetix_dist.trained_policy import Trained

FIRST_ATTEMPTS = 8  # of each policy on a level; all of them only where these solve nothing
PADDED_TO = 256  # levels


def solved_counts(
    env: Environment, player: Player, levels: Level, which: np.ndarray, attempts: int, seed: int
) -> np.ndarray:
    """[W] attempts that solved each level of a batch, 0 for those that are not `which` [W] bool: not played."""
    chosen = np.flatnonzero(which)
    counts = np.zeros(len(which), int)
    if len(chosen):
        unit = min(PADDED_TO, len(which))  # few programs to compile
        padded = np.resize(chosen, -(-len(chosen) // unit) * unit)
        rates = evaluate(env, player, index_worlds(levels, padded), attempts=attempts, key=prng.key(seed))
        counts[chosen] = [level.solved for level in rates.levels[: len(chosen)]]
    return counts


def choose(size: str, policies: dict[str, Trained], arguments: argparse.Namespace) -> FrontierSet:
    env = Environment(EnvConfig(size=size))
    chance = Player(RandomPolicy(env.action_space))
    any_level = stream_levels(size, [0])
    players: list[tuple[Environment, Player]] = []
    for trained in policies.values():
        own = Environment(trained.env_config(size))
        players.append((own, trained.player(own, any_level)))
    found: list[tuple[int, int]] = []  # index, solved by random actions
    num_drawn = 0
    while len(found) < arguments.num_levels and num_drawn < arguments.max_drawn:
        indices = np.arange(num_drawn, num_drawn + arguments.batch)
        num_drawn += arguments.batch
        levels = stream_levels(size, indices.tolist())
        by_chance = solved_counts(env, chance, levels, np.full(arguments.batch, True), arguments.attempts, seed=0)
        is_hard = (by_chance < MAX_RANDOM_RATE * arguments.attempts) & ~np.asarray(noop_solved(levels))
        is_solved = np.full(arguments.batch, False)
        for attempts in {min(FIRST_ATTEMPTS, arguments.attempts): None, arguments.attempts: None}:
            for own, player in players:
                is_solved |= solved_counts(own, player, levels, is_hard & ~is_solved, attempts, seed=attempts) > 0
        found += [(int(indices[i]), int(by_chance[i])) for i in np.flatnonzero(is_hard & is_solved)]
        print(f"{size}: {len(found)} of {num_drawn} levels", flush=True)
    found = found[: arguments.num_levels]
    made = FrontierSet(
        size=size,
        indices=tuple(index for index, _ in found),
        random_solved=tuple(count for _, count in found),
        attempts=arguments.attempts,
        policies=tuple(policies),
        num_drawn=num_drawn,
    )
    return dataclasses.replace(made, fingerprint=fingerprint(frontier_levels(made)[0])) if found else made


def policies_of(names: list[str]) -> dict[str, Trained]:
    """Policies by the names given: pretrained ones, checkpoints, or run directories."""
    return {name: policy_at(Path(name)) for name in names}


def run(arguments: argparse.Namespace) -> int:
    for name in ("num_levels", "max_drawn", "batch", "attempts"):
        if getattr(arguments, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} is {getattr(arguments, name)}; it must be 1 or more")
    enable_compile_cache("")
    policies = policies_of(arguments.policies)
    if not arguments.json.parent.is_dir():
        raise UserError(f"{arguments.json.parent} is not a directory; give --json a file in one that is there")
    with user_errors(ValueError, TypeError, AttributeError, prefix=f"{arguments.json} holds no frontier sets: "):
        known = read_frontier_sets(arguments.json) if arguments.json.is_file() else {}
    for size in arguments.sizes:
        if size in known:
            print(f"{size}: stays as it is in {arguments.json}")
            continue
        made = choose(size, policies, arguments)
        if not made.indices:
            raise UserError(f"size {size}: of {made.num_drawn} levels none is rarely solved by chance and by a policy")
        known[size] = made
        replace_file(arguments.json, frontier_text(known).encode())
    return 0


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--sizes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--policies", nargs="+", required=True)
    parser.add_argument("--json", type=Path, required=True)
    parser.add_argument("--num-levels", type=int, default=512)
    parser.add_argument("--max-drawn", type=int, default=20_000)
    parser.add_argument("--batch", type=int, default=2048)
    parser.add_argument("--attempts", type=int, default=64)
    arguments = parser.parse_args()
    return exit_code(parser, lambda: run(arguments))


if __name__ == "__main__":
    sys.exit(main())
