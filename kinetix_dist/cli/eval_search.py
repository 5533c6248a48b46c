"""`kinetix-dist eval --search SECONDS`: solve rates with planning, in rates of their own.

    kinetix-dist eval --checkpoint generalist --levels all_designed_l --search 10 --json searched.json

evaluation/planning/ searches and executes. Seconds are wall time of planning; compiling is not counted.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

from kinetix_dist.cli.streams import say
from kinetix_dist.cli.text_table import MAX_ROWS, aligned, rows_left_out
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.env.environment import Environment
    from kinetix_dist.evaluation.planning.planner import Plan
    from kinetix_dist.evaluation.planning.search_rates import SearchRates
    from kinetix_dist.evaluation.policies import Player
    from kinetix_dist.level.level import Level

DEFAULT_STARTS = 4


class SearchArgs(Protocol):
    """Options of a search, as `eval` has them."""

    search: float | None
    search_rounds: int | None
    search_worlds: int | None
    search_levels: int | None
    search_starts: int
    seed: int


def wants_search(args: SearchArgs) -> bool:
    return args.search is not None or args.search_rounds is not None


def check_search(args: SearchArgs) -> None:
    """Raises `UserError` for options that make no search."""
    if args.search is not None and args.search_rounds is not None:
        raise UserError("--search gives seconds and --search-rounds rounds; give one of them")
    if args.search is not None and not (args.search > 0 and math.isfinite(args.search)):
        raise UserError(f"--search is {args.search}; give the seconds of search for each level, more than 0")
    for name, least in (("rounds", 1), ("worlds", 16), ("levels", 1), ("starts", 0)):
        number = getattr(args, f"search_{name}")
        if number is not None and number < least:
            raise UserError(f"--search-{name} is {number}; give {least} or more")
    given = args.search_worlds is not None or args.search_levels is not None or args.search_starts != DEFAULT_STARTS
    if given and not wants_search(args):
        raise UserError("--search-worlds, --search-levels and --search-starts are of a search; give --search SECONDS")


def search(args: SearchArgs, env: Environment, player: Player, levels: Level, names: Sequence[str]) -> SearchRates:
    """Raises `UserError` for a policy that cannot be planned with and for more worlds than the device holds."""
    from kinetix_dist.evaluation.planning.planner import default_size
    from kinetix_dist.evaluation.planning.search_rates import SearchOptions, search_rates

    default = default_size()
    with user_errors(ValueError, prefix="--search: "):
        size = dataclasses.replace(
            default,
            num_slots=args.search_levels or default.num_slots,
            num_worlds=args.search_worlds or default.num_worlds,
        )
        options = SearchOptions(
            seconds=args.search,
            rounds=args.search_rounds,
            size=size,
            num_starts=args.search_starts,
            seed=args.seed,
        )
        return search_rates(env, player, levels, names, options, lambda plans: _say_progress(plans, len(names)))


def _say_progress(plans: list[Plan], num_levels: int) -> None:
    """A line on stderr, where a search may take minutes."""
    found = sum(plan.actions is not None for plan in plans)
    say(f"searched {len(plans)} of {num_levels} levels: {found} have a plan", sys.stderr)


def searched_table(rates: SearchRates, base_levels: Sequence[str]) -> str:
    """Each level (up to MAX_ROWS of them), then the rates."""
    levels = rates.to_dict(base_levels)["levels"]
    header = ("level", "policy alone", "with search", "found after", "by", "steps", "robust", "perturbed starts")
    rows: list[tuple[str, ...]] = [header]
    for level in levels[:MAX_ROWS]:
        seconds, starts = level["found_after_seconds"], level["perturbed_starts"]
        rows.append(
            (
                level["name"],
                "solved" if level["policy_alone"] else "-",
                "solved" if level["solved"] else "-",
                "-" if seconds is None else f"{seconds:.2f} s",
                *("-" if level[name] is None else str(level[name]) for name in ("method", "plan_steps")),
                "-" if seconds is None else f"{level['robustness']:.0%}",
                "-" if starts is None else f"{starts:.0%}",
            )
        )
    return "\n".join(["", *aligned(rows), *rows_left_out(len(levels)), "", *_totals(rates, base_levels)])


def _totals(rates: SearchRates, base_levels: Sequence[str]) -> list[str]:
    options, size = rates.options, rates.options.size
    budget = f"{options.seconds:g} s" if options.seconds is not None else f"{options.rounds} rounds"
    lines = [
        f"search of {budget} a level, {size.num_slots} levels at once, {size.num_worlds:,} worlds each: "
        f"{rates.search_seconds:.1f} s in all, and {rates.compile_seconds:.1f} s to compile"
    ]
    named = {"policy alone, one attempt a level": rates.alone, "with search": rates.rate}
    if rates.starts is not None:
        named[f"with search, from {options.num_starts} perturbed starts a level"] = rates.starts
    for name, rate in named.items():
        line = f"{name}: {rate.rate:.1%}, {rate.total.solved} of {rate.attempts}"
        if (over := rate.over_levels(base_levels)) is not None:
            line += f"; on levels like these {over['low']:.1%} - {over['high']:.1%} (95 %)"
        lines.append(line)
    curve = ", ".join(f"{moment:g} {options.unit}: {rates.at(moment):.1%}" for moment in rates.moments)
    lines.append(f"solved after {curve}")
    if rates.num_unconfirmed:
        lines.append(
            f"{rates.num_unconfirmed} executions ended otherwise in the environment than in the planner's engine, "
            "and count as the environment says"
        )
    return lines
