"""`kinetix-dist eval`: solve rates of a trained policy on a set of levels, next to policies that learned nothing.

    kinetix-dist eval --run runs/quickstart --levels designed_s
    kinetix-dist eval --checkpoint pretrained/generalist --levels random_s --attempts 5 --json rates.json
    kinetix-dist eval --policy random --levels designed_m
    kinetix-dist eval --checkpoint pretrained/generalist --levels designed_s --record designed.mcap
    kinetix-dist eval --checkpoint generalist --levels designed_s --search 10

An attempt is one episode from the start of a level; the first to finish counts. Intervals are Wilson's at 95 %, over
attempts: of the rate on these levels. A line below the table has the interval over base levels, for levels like these:
all variants of one level (dev_designed_s, ...) are one observation there. With
--greedy all attempts at a level are the same: each level is tried once, and the interval is one of so many levels.
With --search the policy also plans: `eval_search.py`, in rates of their own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from kinetix_dist import prng
from kinetix_dist.cli.checks import check_count, check_output_file, check_seed
from kinetix_dist.cli.eval_search import DEFAULT_STARTS, check_search, search, searched_table, wants_search
from kinetix_dist.cli.text_table import MAX_ROWS, aligned, rows_left_out
from kinetix_dist.errors import UserError, user_errors
from kinetix_dist.json_text import json_text

if TYPE_CHECKING:
    from kinetix_dist.checkpoint import Checkpoint
    from kinetix_dist.env.environment import Environment
    from kinetix_dist.evaluation.evaluate import SolveRate, SolveRates
    from kinetix_dist.evaluation.policies import Player
    from kinetix_dist.level.level import Level
    from kinetix_dist.trained_policy import Trained

BASELINES = ("random", "noop")
MAX_RECORDED = 100  # levels of a recording
MAX_ATTEMPTS = 10**6  # of each level
MAX_WORLDS = 1 << 24


@dataclasses.dataclass
class Args:
    """Solve rates of a run or a checkpoint on a set of levels."""

    levels: str
    """A set (designed_s, random_s ... with s, m or l), a directory of level files, or one level file."""
    run: Path | None = None
    """A run directory: its newest good checkpoint plays."""
    checkpoint: Path | None = None
    """A checkpoint directory."""
    policy: Literal["trained", "random", "noop"] = "trained"
    """`random` (uniform actions) and `noop` (none) need neither --run nor --checkpoint."""
    baselines: bool = True
    """Beside a trained policy, also say how random actions and no actions do on the same levels."""
    size: str | None = None
    """Play levels from files at this size (s, m or l) instead of the smallest that fits all of them."""
    attempts: int = 5
    """Episodes of each level; one where all would be the same (--greedy, --policy noop)."""
    preset: Annotated[str | None, tyro.conf.arg(name="env.preset")] = None
    """Play with the solver settings of this preset instead of those that the policy was trained with."""
    greedy: bool = False
    """Most likely actions instead of samples."""
    seed: int = 0
    """Seed of the actions drawn."""
    max_worlds: int = 4096
    """Episodes played at once, a matter of memory: the rates do not depend on it."""
    json: Path | None = None
    """Also write the results, level by level, to this file."""
    record: Path | None = None
    """Also write one rollout of each of the first 100 levels to this new MCAP file, for `kinetix-dist replay`."""
    search: float | None = None
    """Also plan: seconds of search for each level, with the policy as prior; reported apart from the other rates."""
    search_rounds: int | None = None
    """Rounds of search for each level instead of seconds: the result depends on the seed alone."""
    search_worlds: int | None = None
    """Worlds that the search of a level plays at once; left out: 2048 on a GPU, 256 on a CPU."""
    search_levels: int | None = None
    """Levels that are searched at once and share the seconds; left out: 8 on a GPU, 1 on a CPU."""
    search_starts: int = DEFAULT_STARTS
    """Perturbed starts of each level from which its plan is executed too; 0: none."""


def run(args: Args) -> int:
    check(args)
    trained = trained_of(args)
    checkpoint = None if trained is None else trained.checkpoint
    from kinetix_dist.cli.checks import start_computing
    from kinetix_dist.env.env_config import describe
    from kinetix_dist.level.level_data import base_levels
    from kinetix_dist.level.sets import load_level_set

    start_computing()
    with user_errors(ValueError, OSError):
        levels, names = load_level_set(args.levels, args.size)
    env = environment_of(args.preset, trained, levels)
    players = players_of(args, trained, env, levels)
    rates = _evaluate(args, env, players, levels, list(names))
    first, bases = next(iter(rates)), base_levels(args.levels, names)
    print(
        f"{args.levels}: {len(names)} levels, {_attempts_in_words(rates[first], args.attempts)}, "
        f"policy {_policy_name(args, checkpoint)}, physics {describe(env.config.physics)}"
    )
    print(table(first, rates))
    print(summary(rates, bases))
    searched = search(args, env, players[first], levels, names) if wants_search(args) else None
    if searched is not None:
        print(searched_table(searched, bases))
    if args.json is not None:
        content = {
            "levels": args.levels,
            "checkpoint": None if checkpoint is None else str(checkpoint.path),
            "policy_version": None if checkpoint is None else checkpoint.description["num_updates"],
            "attempts_per_level": rates[first].attempts_per_level,
            "seed": args.seed,
            "greedy": args.greedy,
            "physics": describe(env.config.physics),
            "solve_rate": {
                name: rate.to_dict() | {"interval_over_levels": rate.over_levels(bases)} for name, rate in rates.items()
            },
            "above_random": {name: _above_random(name, rates) for name in rates},
        }
        if searched is not None:
            content["search"] = searched.to_dict(bases)
        with user_errors(OSError, prefix="the results cannot be written: "):
            args.json.write_text(json_text(content, indent=2) + "\n")
        print(f"results  {args.json}")
    if args.record is not None:
        num_recorded = _record(args, checkpoint, env, players[first], levels, list(names))
        print(f"recorded  {num_recorded} rollouts of {first}: kinetix-dist replay {args.record} --list")
    return 0


def _attempts_in_words(rates: SolveRates, requested: int) -> str:
    number = rates.attempts_per_level
    if number == requested:
        return f"{number} attempts each"
    return f"one attempt each (all {requested} are the same, since nothing is drawn: n is the number of levels)"


def table(name: str, rates: dict[str, SolveRates]) -> str:
    """Every level of `name` (up to MAX_ROWS of them), then the totals of all policies."""
    levels = rates[name].levels
    rows = [_cells(level.name, level) for level in levels[:MAX_ROWS]]
    totals = [_cells(f"all, {policy}", result.total) for policy, result in rates.items()]
    header = (
        "level",
        "solved",
        "95 % interval",
        "attempts",
        "touched red",
        "out of time",
        "unstable",
        "return",
        "steps",
    )
    top, *lines = aligned([header, *rows, *totals])
    rule = "-" * len(top)
    of_levels, of_totals = lines[: len(rows)], lines[len(rows) :]
    return "\n".join([top, rule, *of_levels, *rows_left_out(len(levels)), rule, *of_totals])


def summary(rates: dict[str, SolveRates], base_levels: Sequence[str]) -> str:
    """A line for each policy with what its mean rate does not say. docs/training.md says what the numbers mean."""
    lines = []
    for name, rate in rates.items():
        best = ", ".join(f"{k}: {share:.1%}" for k, share in rate.best_of.items())
        parts = [f"worst tenth of the levels {rate.worst_tenth:.1%}", f"levels solved by the best of {best}"]
        if (above := _above_random(name, rates)) is not None:
            points = 100 * (rates["random"].rate - rate.rate)
            better = f"solves {above:.1%} of what random actions fail at"
            parts.append(better if above >= 0 else f"{points:.1f} points below random actions")
        if (over := rate.over_levels(base_levels)) is not None:
            number = over["base_levels"]
            parts.append(f"on levels like these {over['low']:.1%} - {over['high']:.1%} (95 %, {number} base levels)")
        lines.append(f"{name}: {'; '.join(parts)}")
    return "\n".join(lines)


def _above_random(name: str, rates: dict[str, SolveRates]) -> float | None:
    """`summary.above_random` where random actions played too; None for themselves."""
    from kinetix_dist.evaluation.summary import above_random

    return above_random(rates[name].rate, rates["random"].rate) if "random" in rates and name != "random" else None


def _cells(name: str, rate: SolveRate) -> tuple[str, ...]:
    return (
        name,
        f"{rate.rate:.1%}",
        f"{rate.low:.1%} - {rate.high:.1%}",
        str(rate.attempts),
        str(rate.failed),
        str(rate.timed_out),
        str(rate.unstable),
        f"{rate.mean_return:.3f}",
        f"{rate.mean_length:.1f}",
    )


def check(args: Args) -> None:
    """Complains before anything slow happens."""
    given = [name for name in ("run", "checkpoint") if getattr(args, name) is not None]
    if args.policy == "trained" and len(given) != 1:
        what = "both were given" if given else "neither was given"
        raise UserError(f"a trained policy comes from --run or --checkpoint, {what}; or choose --policy random")
    if args.policy != "trained" and given:
        raise UserError(f"--policy {args.policy} plays without --{given[0]}; leave one of them out")
    check_count("attempts", args.attempts, MAX_ATTEMPTS)
    check_count("max_worlds", args.max_worlds, MAX_WORLDS)
    if args.preset is not None:
        from jax2d.settings import preset

        with user_errors(ValueError):
            preset(args.preset)
    for name, file in (("json", args.json), ("record", args.record)):
        if file is not None:
            check_output_file(file, f"--{name}")
    check_seed(args.seed)
    check_search(args)
    if args.record is not None and (args.record.exists() or args.record.is_symlink() or args.record == args.json):
        raise UserError(f"{args.record} exists and recordings are never overwritten; give --record a new file")


def trained_of(args: Args) -> Trained | None:
    """The checkpoint to play and the config it was trained with; None for a baseline."""
    if args.policy != "trained":
        return None
    from kinetix_dist.trained_policy import checkpoint_at, newest_checkpoint_of

    if args.checkpoint is not None:
        if (args.checkpoint / "checkpoints").is_dir():
            raise UserError(f"{args.checkpoint} is a run directory; give it as --run {args.checkpoint}")
        return checkpoint_at(args.checkpoint)
    assert args.run is not None  # check saw to it
    trained, rejected = newest_checkpoint_of(args.run)
    for bad in rejected:
        print(f"checkpoint {bad.path.name} passed over: {bad.reason}")
    return trained


def environment_of(preset_name: str | None, trained: Trained | None, levels: Level) -> Environment:
    """The environment that the policy was trained in, or the default one; with the requested physics."""
    from jax2d.settings import preset
    from kinetix_dist.env.environment import EnvConfig, Environment
    from kinetix_dist.level.fit import capacity_of
    from kinetix_dist.level.level import SIZES

    capacity = capacity_of(levels)
    size = next(name for name, known in SIZES.items() if known == capacity)
    env_config = EnvConfig(size=size) if trained is None else trained.env_config(size)
    if preset_name is not None:
        env_config = dataclasses.replace(env_config, physics=preset(preset_name))
    return Environment(env_config)


def players_of(args: Args, trained: Trained | None, env: Environment, levels: Level) -> dict[str, Player]:
    """Players by name, the requested one first."""
    from kinetix_dist.evaluation.policies import NoopPolicy, Player, RandomPolicy

    players: dict[str, Player] = {}
    if trained is not None:
        players["trained"] = trained.player(env, levels, greedy=args.greedy)
    baselines = {"random": RandomPolicy(env.action_space), "noop": NoopPolicy(env.action_space)}
    for name in BASELINES if args.policy == "trained" and args.baselines else (args.policy,):
        if name in baselines:
            players[name] = Player(baselines[name])
    return players


def _evaluate(
    args: Args, env: Environment, players: dict[str, Player], levels: Level, names: list[str]
) -> dict[str, SolveRates]:
    """Solve rates by policy, in the order of `players`."""

    from kinetix_dist.evaluation.evaluate import evaluate

    key = prng.key(args.seed)
    results = {}
    for name, player in players.items():
        results[name] = evaluate(
            env, player, levels, attempts=args.attempts, key=key, names=names, max_worlds=args.max_worlds
        )
    return results


def _record(
    args: Args,
    checkpoint: Checkpoint | None,
    env: Environment,
    player: Player,
    levels: Level,
    names: list[str],
) -> int:
    """Writes one rollout of each level, MAX_RECORDED at most; returns how many."""
    import jax

    from kinetix_dist.evaluation.recordings import RANDOM_POLICY_VERSION, record_rollouts
    from kinetix_dist.telemetry.sinks.mcap import McapSink

    assert args.record is not None
    rollouts = record_rollouts(
        env,
        player,
        jax.tree.map(lambda x: x[:MAX_RECORDED], levels),
        prng.key(args.seed),
        names=names[:MAX_RECORDED],
        policy_version=RANDOM_POLICY_VERSION if checkpoint is None else checkpoint.description["num_updates"],
        seed=args.seed,
    )
    problems: list[str] = []

    def on_event(name: str, fields: dict[str, Any]) -> None:
        problems.append(f"{name}: " + ", ".join(f"{key} {value}" for key, value in fields.items()))

    with (
        user_errors(OSError, prefix="the recording cannot be written: "),
        McapSink(args.record, max_queued=len(rollouts), on_event=on_event) as sink,
    ):
        for rollout in rollouts:
            sink.write(rollout)
    if problems:
        raise UserError(f"the recording is not whole: {problems[0]}")
    return len(rollouts)


def _policy_name(args: Args, checkpoint: Checkpoint | None) -> str:
    return args.policy if checkpoint is None else f"of {checkpoint.path}"
