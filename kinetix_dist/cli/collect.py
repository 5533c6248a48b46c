"""`kinetix-dist collect`: plays a policy and stores its transitions as a data set.

    kinetix-dist collect --policy generalist --levels designed_s --transitions 1e6 --out data
    kinetix-dist collect --policy runs/quickstart --levels designed_s --noise 0.1 --sticky 0.1 --out noisy
    kinetix-dist collect --policy random --levels random_s --out random
    kinetix-dist collect --policy runs/experts --levels levels12 --transitions 12e6 --out data12

The same command goes on with a collection that was stopped or killed, and with more --transitions adds to one that was
finished. A directory of specialists (`finetune --each`) plays each level by its own, of several seeds in turns.
docs/data.md describes the files.
"""

from __future__ import annotations

import dataclasses
import math
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from kinetix_dist.cli.checks import check_count, check_output_directory, check_seed
from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, one_line, user_errors

if TYPE_CHECKING:
    from kinetix_dist.data.collect import Collection
    from kinetix_dist.data.shards import Shard
    from kinetix_dist.level.level import Level
    from kinetix_dist.trained_policy import Trained

BASELINES = ("random", "noop")
NO_VERSION = -1  # of a policy that has learned nothing
DEFAULT_WORLDS = {"gpu": 2048, "cpu": 64}
DEFAULT_SHARD = {"gpu": 1 << 20, "cpu": 1 << 16}  # transitions: 512 and 1,024 steps of each world
# Of specialists: a shard is of one of them, and a million transitions of a level are to be of eight.
DEFAULT_WORLDS_OF_SPECIALISTS = {"gpu": 256, "cpu": 64}
DEFAULT_SHARD_OF_SPECIALISTS = {"gpu": 1 << 17, "cpu": 1 << 16}
MAX_TRANSITIONS = 10**12  # more than 10 TB
MAX_SHARD = 1 << 30  # transitions, all in memory
SECONDS_BETWEEN_LINES = 5.0
WARM_SHARDS = 8  # a rate is that of more


@dataclasses.dataclass
class Args:
    """Play a policy and store its transitions as a data set."""

    policy: str
    """A run, a checkpoint, a pretrained policy by name (generalist), specialists of `finetune --each`, one a level,
    `random` (uniform actions) or `noop` (none)."""
    levels: str
    """A set (designed_s, random_s ... with s, m or l), a directory of level files, or one level file."""
    out: Path
    """Directory of the data set: a new one, or one of the same command, which goes on."""
    transitions: float = 1e6
    """Transitions, rounded up to whole shards."""
    size: str | None = None
    """Levels from files in arrays of this size (s, m or l) instead of the smallest that fits all of them."""
    preset: Annotated[str | None, tyro.conf.arg(name="env.preset")] = None
    """Play with the solver settings of this preset instead of those that the policy was trained with."""
    noise: float = 0.0
    """Probability that a step executes a uniform action instead of the policy's."""
    sticky: float = 0.0
    """Probability that a step executes the action of the step before instead."""
    min_rate: float | None = None
    """Specialists play that solved this share of their level at the end of training; left out: 0.65, as published."""
    greedy: bool = False
    """Most likely actions instead of samples."""
    worlds: int | None = None
    """Worlds that play at once, each one level a shard; left out: 2048 on a GPU (256 of specialists), 64 on a CPU."""
    shard_transitions: int | None = None
    """Transitions of a shard, a multiple of --worlds; left out: 2^20 on a GPU (2^17 of specialists), 2^16 on a CPU."""
    seed: int = 0
    """Seed of actions, disturbances and the order of levels."""


def run(args: Args) -> int:
    check(args)
    from kinetix_dist.cli.checks import start_computing
    from kinetix_dist.data import DatasetError
    from kinetix_dist.stored_specialists import are_specialists

    has_specialists = args.policy not in BASELINES and are_specialists(Path(args.policy))
    if args.min_rate is not None and not has_specialists:
        raise UserError(f"--min-rate is of specialists, and --policy is {args.policy}; leave it out")
    trained = None if has_specialists else _trained(args.policy)
    start_computing()
    with user_errors(DatasetError, ValueError):
        collection = _of_specialists(args) if has_specialists else _collection(args, trained)
    num_levels = len(collection.turns) or 1  # each has as many shards as any other
    num_shards = math.ceil(args.transitions / collection.rows_per_shard / num_levels) * num_levels
    print(
        f"collecting {num_shards * collection.rows_per_shard:,} transitions of {args.levels} into {args.out}: "
        f"{num_shards} shards of {collection.num_worlds} worlds x {collection.num_steps} steps",
        flush=True,
    )
    if too_few := _too_few_shards(collection, num_shards // num_levels):
        print(too_few, flush=True)
    return _collect(args.out, collection, num_shards)


def _too_few_shards(collection: Collection, shards_per_level: int) -> str:
    """Line about specialists that have no turn; "": all have one."""
    most = max(map(len, collection.turns), default=0)
    if most <= shards_per_level:
        return ""
    return (
        f"{most} specialists take turns at a level, and it has {shards_per_level} shards: the others do not play; give "
        "more --transitions or fewer --shard-transitions"
    )


def check(args: Args) -> None:
    """Complains before anything slow happens."""
    for name in ("noise", "sticky"):
        if not 0 <= getattr(args, name) < 1:
            raise UserError(f"--{name} is {getattr(args, name)}; it is a probability, from 0 to below 1")
    for name, most in (("transitions", MAX_TRANSITIONS), ("worlds", MAX_SHARD), ("shard_transitions", MAX_SHARD)):
        check_count(name, getattr(args, name), most)
    if args.min_rate is not None and not 0 <= args.min_rate <= 1:
        raise UserError(f"--min-rate is {args.min_rate:g}; it is a solve rate, from 0 to 1")
    if args.greedy and args.policy in BASELINES:
        raise UserError(f"--greedy is for trained policies, and --policy is {args.policy}; leave it out")
    if args.preset is not None:
        from jax2d.settings import preset

        with user_errors(ValueError):
            preset(args.preset)
    check_seed(args.seed)
    check_output_directory(args.out, "--out")


def _trained(policy: str) -> Trained | None:
    """The checkpoint that plays; None for a baseline."""
    from kinetix_dist.trained_policy import trained_at

    if policy in BASELINES:
        return None
    if not policy:
        raise UserError("--policy is empty; name a run, a checkpoint or a pretrained policy, or random or noop")
    return trained_at(Path(policy))


def _collection(args: Args, trained: Trained | None) -> Collection:
    from kinetix_dist.cli.eval_command import environment_of
    from kinetix_dist.data.collect import Collection
    from kinetix_dist.evaluation.policies import NoopPolicy, Player, RandomPolicy

    levels, names = _levels_of(args)
    env = environment_of(args.preset, trained, levels)
    if trained is not None:
        player = trained.player(env, levels, greedy=args.greedy)
    else:
        player = Player({"random": RandomPolicy, "noop": NoopPolicy}[args.policy](env.action_space))
    return Collection(
        env=env,
        player=player,
        policy=_description(args, trained),
        levels=levels,
        level_names=names,
        **_common(args, DEFAULT_WORLDS, DEFAULT_SHARD),
    )


def _levels_of(args: Args) -> tuple[Level, list[str]]:
    """Levels and their names. Raises UserError."""
    from kinetix_dist.level.sets import load_level_set

    with user_errors(ValueError, OSError):
        levels, names = load_level_set(args.levels, args.size)
    return levels, list(names)


def _common(args: Args, default_worlds: dict[str, int], default_shard: dict[str, int]) -> dict[str, Any]:
    """Fields of a collection that do not depend on who plays."""
    from kinetix_dist.data.rollout import Disturbance

    worlds, steps = _worlds_and_steps(args, default_worlds, default_shard)
    return {
        "level_set": args.levels,
        "disturbance": Disturbance(noise=args.noise, sticky=args.sticky),
        "num_worlds": worlds,
        "num_steps": steps,
        "seed": args.seed,
    }


def _worlds_and_steps(args: Args, default_worlds: dict[str, int], default_shard: dict[str, int]) -> tuple[int, int]:
    """(worlds, steps of each in a shard). Raises UserError where they do not divide."""
    import jax

    device = "cpu" if jax.default_backend() == "cpu" else "gpu"
    worlds = args.worlds or default_worlds[device]
    per_shard = args.shard_transitions or default_shard[device]
    if per_shard % worlds:
        raise UserError(f"--shard-transitions {per_shard} is not a multiple of --worlds {worlds}; change one")
    return worlds, per_shard // worlds


def _of_specialists(args: Args) -> Collection:
    """Each level by its own specialists, which take turns."""
    from kinetix_dist.cli.eval_command import environment_of
    from kinetix_dist.data.collect import Collection, Turn
    from kinetix_dist.stored_specialists import specialists_of

    levels, names = _levels_of(args)
    chosen = specialists_of(Path(args.policy), levels, names, min_rate=args.min_rate)
    for line in chosen.left_out:
        print(f"left out: {line}", flush=True)
    env = environment_of(args.preset, chosen.first, levels)
    players = chosen.players(env, levels, greedy=args.greedy)
    turns = tuple(
        tuple(
            Turn(player=player, version=one.trained.num_updates) for player, one in zip(own, specialists, strict=True)
        )
        for own, specialists in zip(players, chosen.by_level, strict=True)
    )
    return Collection(
        env=env,
        player=players[0][0],
        policy=chosen.description | {"greedy": args.greedy},
        levels=levels,
        level_names=names,
        **_common(args, DEFAULT_WORLDS_OF_SPECIALISTS, DEFAULT_SHARD_OF_SPECIALISTS),
        turns=turns,
    )


def _description(args: Args, trained: Trained | None) -> dict[str, Any]:
    """Policy of the manifest. sha256: of the parameters that play, by name."""
    if trained is None:
        return {"name": args.policy, "version": NO_VERSION, "sha256": "", "greedy": False}
    from kinetix_dist.evaluation.load_policy import released_arrays
    from kinetix_dist.stored_specialists import digest_of_arrays

    name, sha256 = Path(args.policy).name or args.policy, digest_of_arrays(released_arrays(trained.checkpoint))
    return {"name": name, "version": trained.num_updates, "sha256": sha256, "greedy": args.greedy}


def _collect(out: Path, collection: Collection, num_shards: int) -> int:
    from kinetix_dist.data import DatasetError
    from kinetix_dist.data.collect import collect
    from kinetix_dist.runtime import EXIT_STOPPED

    made: list[Shard] = []
    began = time.monotonic()
    times: list[float] = []  # s at which each shard was written
    said = -SECONDS_BETWEEN_LINES

    def on_shard(shard: Shard, seconds: float) -> None:
        nonlocal said
        made.append(shard)
        times.append(seconds)
        if seconds >= said + SECONDS_BETWEEN_LINES or shard.shard == num_shards - 1:
            said = seconds
            say(_progress(made, shard, num_shards, seconds), sys.stdout)

    try:
        shards = collect(collection, out, num_shards, on_shard)
    except DatasetError as error:
        raise UserError(one_line(error)) from None
    except KeyboardInterrupt:
        say(f"kinetix-dist: stopped after {len(made)} shards; the same command goes on", sys.stderr)
        return EXIT_STOPPED
    except OSError as error:
        raise UserError(
            f"shard {len(made)} of this command cannot be written ({one_line(error.strerror or error)}); the "
            f"{len(made)} before it are whole, and the same command goes on"
        ) from None
    num_rows = sum(shard.rows for shard in shards)
    num_bytes = sum(shard.bytes for shard in shards)
    lines = [f"{out}: {num_rows:,} transitions in {len(shards)} shards, {num_bytes / num_rows:.1f} bytes a transition"]
    if not made:
        lines = [f"{lines[0]}; nothing was missing"]
    elif len(made) > WARM_SHARDS:  # the first one compiles, and the next is played while one is written
        rate = sum(shard.rows for shard in made[1:]) / max(times[-1] - times[0], 1e-9)
        lines.append(f"{60 * rate:,.0f} transitions a minute after the first shard, {time.monotonic() - began:.0f} s")
    else:
        made_rows = sum(shard.rows for shard in made)
        lines.append(f"{made_rows:,} transitions in {times[-1]:.0f} s, compiling included")
    print("\n".join(lines))
    return 0


def _progress(made: list[Shard], shard: Shard, num_shards: int, seconds: float) -> str:
    episodes, solved = (sum(getattr(each, name) for each in made) for name in ("episodes", "solved"))
    return (
        f"shard {shard.shard + 1} of {num_shards}  {seconds:.0f} s  {shard.bytes / 1e6:.1f} MB  "
        f"{solved / max(episodes, 1):.1%} of {episodes:,} episodes solved"
    )
