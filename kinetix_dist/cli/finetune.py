"""`kinetix-dist finetune`: trains on a set of levels from a policy that exists, or one policy for each level.

    kinetix-dist finetune --from generalist --levels designed_s                    one policy for all of them
    kinetix-dist finetune --from generalist --levels designed_s --each             one per level
    kinetix-dist finetune --from generalist --levels designed_s --each --compare   and from scratch, with a picture
    kinetix-dist finetune --from generalist --levels designed_s --each --gif after.gif   and how they play
    kinetix-dist finetune --levels designed_s --each                               from scratch alone
    kinetix-dist finetune --levels mine --each --seeds 0..7 --together 12 --slots 0   eight seeds, over all free GPUs

Network and environment are those of the policy, everything else is a recipe's; all options of `train` override it.
Without --each it is an ordinary run of `train`. With --each results are stored as they come, and the same command
again goes on where it was stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinetix_dist.cli import train
from kinetix_dist.cli.checks import MAX_SEED, check_output_directory, check_output_file
from kinetix_dist.cli.option_help import wants_help
from kinetix_dist.cli.specialist_slots import check_slots, hold_to_cpu, slots_of, train_in_slots
from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, one_line, user_errors
from kinetix_dist.number_ranges import numbers_in

if TYPE_CHECKING:
    from kinetix_dist.config import TrainConfig
    from kinetix_dist.finetune.each import Plan
    from kinetix_dist.finetune.specialists import Start
    from kinetix_dist.stored_specialists import Record

PROG = "kinetix-dist finetune"
DEFAULT_RECIPE = "single_level"
CURRICULUM = "fixed"
MAX_TABLE_WIDTH = 200  # characters; a terminal that is narrower breaks lines, but cuts no number
PICTURE_NAME, CARD_NAME = "samples.png", "README.md"
USAGE = f"""usage: {PROG} --levels SET [--from CKPT] [--each [--compare]] [options of train]

  --levels SET    a level set, a level, a level file or a directory of them
  --from CKPT     a checkpoint, a run (its newest checkpoint) or a pretrained policy; left out: from scratch
  --each          one specialist per level, on one device; --run is the directory of the results (default
                  runs/finetune-SET), and the same command goes on where it was stopped
  --compare       with --each and --from: specialists from scratch too
  --seeds S       with --each: every level with each of these seeds, such as 0..7 or 0 3 5, in START-seed-S of --run;
                  more of them may be added later. Left out: one seed, --run.seed
  --slots N       with --each: N programs of specialists at a time, each on a GPU of its own, or on a share of the CPU
                  cores; 0: all free GPUs. Left out: one, in this process
  --part K/N      with --each: every N-th specialist alone, the K-th of them first; K from 0 to N - 1. Parts have
                  directories of their own, so that several machines share a level set
  --together N    with --each: N specialists, levels or seeds, at a time in one program (default 1); they come out as
                  they do alone, and sooner on a GPU that one does not fill
  --stop-at RATE  with --each: a specialist ends at the first evaluation that solves this share (default: none)
  --gif FILE      with --each: a moving picture, each level before training on it and after
  --draw DIR      only draw the picture again, from the results stored there; with --gif, the moving one too

"""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args:
    """Command line as `parse` has read it."""

    train: train.Args | None  # None: only draw
    starts: tuple[Start, ...] = ()  # with --each
    each: bool = False
    has_size: bool = False  # whether env.size was given
    stop_at: float = 0.0
    seeds: tuple[int, ...] = ()  # (): run.seed
    part: tuple[int, int] = (0, 1)  # which of how many shares of the specialists
    together: int = 1  # specialists at a time
    slots: int | None = None  # worker slots; None: this process
    words: tuple[str, ...] = ()  # of this command without --run, --part and --slots, for a process in a slot
    draw: Path | None = None
    gif: Path | None = None
    go_on: str = "the same command goes on"  # ends the line that is printed where the command is stopped


def parse(argv: Sequence[str]) -> Args:
    """Options of the command itself first; the rest is that of `train`."""
    own = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    own.add_argument("--levels")
    own.add_argument("--from", dest="start")
    own.add_argument("--each", action="store_true")
    own.add_argument("--compare", action="store_true")
    own.add_argument("--stop-at", type=float)
    own.add_argument("--seeds", nargs="+")
    own.add_argument("--slots", type=int)
    own.add_argument("--part")
    own.add_argument("--together", type=int)
    own.add_argument("--draw", type=Path)
    own.add_argument("--gif", type=Path)
    try:
        known, rest = own.parse_known_args(list(argv))
    except argparse.ArgumentError as error:
        raise UserError(f"{one_line(error)}; see `{PROG} --help`") from None
    if wants_help(rest):
        print(USAGE)
        train.parse(rest, prog=PROG, default_recipe=DEFAULT_RECIPE)  # prints what there is and ends
    if known.draw is not None:
        if rest or any(value for name, value in vars(known).items() if name not in ("draw", "gif")):
            raise UserError("--draw takes the directory of the results, and no other option than --gif")
        _check_gif(known.gif)
        return Args(train=None, draw=known.draw, gif=known.gif)
    if "--resume" in rest:
        if known.levels or known.start or known.each or known.gif:
            raise UserError("--resume goes on with a run as it is; leave --levels, --from, --each and --gif out")
        return Args(train=train.parse(rest, prog=PROG))
    return _parse_new(known, rest)


def _parse_new(known: argparse.Namespace, rest: list[str]) -> Args:
    _check(known, rest)
    if known.slots is not None:
        hold_to_cpu()  # before a checkpoint is read
    elif known.start is not None:
        _hold_to_cpu_early(known, rest)
    from kinetix_dist.finetune.specialists import SCRATCH, like_policy, policy_at, start_from

    trained = None if known.start is None else policy_at(Path(known.start))
    start = SCRATCH if trained is None else start_from(trained)

    def adjust(recipe: TrainConfig) -> TrainConfig:
        """The recipe for the requested levels and policy."""
        run = dataclasses.replace(recipe.run, name="finetune", start_from=start.checkpoint)
        if known.each:
            run = dataclasses.replace(run, placement="local")
        config = dataclasses.replace(
            recipe,
            curriculum=dataclasses.replace(recipe.curriculum, name=CURRICULUM, levels=known.levels),
            evaluation=dataclasses.replace(recipe.evaluation, sets=(known.levels,)),
            run=run,
        )
        with user_errors(ValueError):
            return config if trained is None else like_policy(config, trained)

    args = train.parse(rest, prog=PROG, default_recipe=DEFAULT_RECIPE, adjust=adjust)
    if (name := args.config.curriculum.name) != CURRICULUM:
        raise UserError(f"curriculum.name is {name!r}, but finetune trains on --levels: {CURRICULUM!r}; leave it out")
    if known.each and args.config.run.imitation_steps:
        raise UserError("run.imitation_steps is of one run; leave --each out, or run.imitation_steps")
    has_size = any(word.split("=")[0] == "--env.size" for word in rest)
    return Args(
        train=args,
        starts=(SCRATCH, start) if known.compare else (start,),
        each=known.each,
        has_size=has_size,
        stop_at=known.stop_at or 0.0,
        seeds=() if known.seeds is None else _seeds_of(known.seeds),
        slots=known.slots,
        words=_words_of(known, rest),
        part=(0, 1) if known.part is None else _part_of(known.part),
        together=known.together or 1,
        gif=known.gif,
    )


def _hold_to_cpu_early(known: argparse.Namespace, rest: Sequence[str]) -> None:
    """Keeps JAX off the GPUs that `train` will keep it off, before a checkpoint is read: reading one starts JAX.

    The whole configuration is not known yet: network and environment are those of the checkpoint.
    """
    from kinetix_dist.runtime import PlacementError, hold_to_cpu

    own = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    own.add_argument("--recipe", default=DEFAULT_RECIPE)
    own.add_argument("--run.placement", dest="placement")
    own.add_argument("--run.device", dest="device")
    try:
        options = vars(own.parse_known_args(list(rest))[0])
    except argparse.ArgumentError as error:
        raise UserError(f"{one_line(error)}; see `{PROG} --help`") from None
    run = train.recipe_or_run(options.pop("recipe")).run
    changed: dict[str, Any] = {"placement": "local"} if known.each else {}
    changed |= {name: value for name, value in options.items() if value is not None}
    with user_errors(ValueError, PlacementError):
        hold_to_cpu(dataclasses.replace(run, **changed))


def _seeds_of(words: Sequence[str]) -> tuple[int, ...]:
    with user_errors(ValueError):
        return tuple(numbers_in(words, "--seeds", most=MAX_SEED))


def _words_of(known: argparse.Namespace, rest: Sequence[str]) -> tuple[str, ...]:
    """Words of this command for a process in a slot."""
    own = ["--levels", known.levels, "--each", *(["--compare"] if known.compare else [])]
    for option, value in (("--from", known.start), ("--stop-at", known.stop_at), ("--together", known.together)):
        own += [] if value is None else [option, str(value)]
    own += [] if known.seeds is None else ["--seeds", *known.seeds]
    is_path = False
    for word in rest:
        if not is_path and word.split("=")[0] != "--run":
            own.append(word)
        is_path = word == "--run"
    return tuple(own)


def _part_of(word: str) -> tuple[int, int]:
    """K/N as numbers. Raises UserError for what is no part."""
    number, slash, count = word.partition("/")
    if not (slash and number.isdecimal() and count.isdecimal() and int(number) < int(count)):
        raise UserError(f"--part is {word!r}; give K/N, which of N shares of the specialists, such as 0/4 to 3/4")
    return int(number), int(count)


def _check(known: argparse.Namespace, rest: Sequence[str]) -> None:
    if not known.levels:
        raise UserError(f"--levels is missing: the levels to train on; see `{PROG} --help`")
    if known.start == "":
        raise UserError("--from is empty; name a checkpoint, a run or a pretrained policy, or leave it out")
    if known.compare and not (known.each and known.start):
        raise UserError("--compare puts specialists from scratch next to those of a policy; give --each and --from too")
    if known.part is not None and not known.each:
        raise UserError("--part is a share of the specialists; give --each too")
    if known.seeds is not None and not known.each:
        raise UserError("--seeds is of specialists; give --each too, or --run.seed to a run")
    if known.seeds is not None and any(word.split("=")[0] == "--run.seed" for word in rest):
        raise UserError("--seeds and --run.seed are both given; leave one of them out")
    if known.seeds is not None:
        _seeds_of(known.seeds)
    if known.slots is not None and not known.each:
        raise UserError("--slots are of specialists; give --each too")
    if known.slots is not None:
        check_slots(known.slots)
    if known.together is not None and not known.each:
        raise UserError("--together is how many specialists train at a time; give --each too")
    if known.together is not None and known.together < 1:
        raise UserError(f"--together is {known.together}; give 1 or more")
    if known.stop_at is not None and not known.each:
        raise UserError("--stop-at is when a specialist ends; give --each too")
    if known.stop_at is not None and not 0.0 < known.stop_at <= 1.0:
        raise UserError(f"--stop-at is {known.stop_at}; give a solve rate above 0, at most 1")
    if known.gif is not None and not known.each:
        raise UserError("--gif shows specialists; give --each too, or --record to `kinetix-dist eval` for a run")
    _check_gif(known.gif)


def _check_gif(file: Path | None) -> None:
    if file is None:
        return
    if file.suffix.lower() != ".gif":
        raise UserError(f"--gif is {str(file)!r}; name a file that ends in .gif")
    check_output_file(file, "--gif")


def run(args: Args) -> int:
    if args.draw is not None:
        return _draw(args.draw, args.gif)
    assert args.train is not None
    if args.train.resume:
        return train.run(args.train)
    config = sized(args.train.config, has_size=args.has_size)
    if args.each:
        return _each(args, config)
    return train.run(dataclasses.replace(args.train, config=config))


def sized(config: TrainConfig, *, has_size: bool) -> TrainConfig:
    """The configuration with the size of the largest level, unless one was given or the policy plays one size only."""
    from kinetix_dist.cli.checks import start_computing
    from kinetix_dist.env.observations import OBSERVATIONS, VECTOR
    from kinetix_dist.level.fit import capacity_of
    from kinetix_dist.level.level import SIZES
    from kinetix_dist.level.sets import load_level_set
    from kinetix_dist.runtime import PlacementError, hold_to_cpu

    with user_errors(PlacementError):
        hold_to_cpu(config.run)
    start_computing(config.run.compile_cache)  # reading levels computes
    has_one_size = config.run.start_from and OBSERVATIONS[config.env.observation].gives == VECTOR
    size = config.env.size if has_size or has_one_size else None
    with user_errors(ValueError, OSError, prefix="" if size is None else f"env.size is {size!r}: "):
        levels, _ = load_level_set(config.curriculum.levels, size)
    capacity = capacity_of(levels)
    size = next(name for name, known in SIZES.items() if known == capacity)
    return dataclasses.replace(config, env=dataclasses.replace(config.env, size=size))


def _each(args: Args, config: TrainConfig) -> int:
    from kinetix_dist.finetune.each import Plan

    assert args.train is not None
    path = args.train.run or train.RUNS / f"finetune-{Path(config.curriculum.levels).stem}"
    check_output_directory(path, "--run")
    if (path / "config.json").exists():
        raise UserError(f"{path} holds a run; give --run another directory for the results of specialists")
    plan = Plan(starts=args.starts, seeds=args.seeds, stop_at=args.stop_at, part=args.part, together=args.together)
    starts = " and ".join(start.label for start in args.starts)
    seeds = f", seeds {', '.join(map(str, args.seeds))}" if args.seeds else ""
    number, count = args.part
    share = f", those of part {number} of {count}" if count > 1 else ""
    print(f"one specialist per level of {config.curriculum.levels}{share}, {starts}{seeds}, in {path}", flush=True)
    if config.cut_episodes:
        print(config.cut_episodes, flush=True)
    if args.slots is not None:
        status = train_in_slots(config, plan, path, (*args.words, "--run", str(path)), slots_of(config, args.slots))
    else:
        status = _train_here(args, config, plan, path)
    return status or _show(path, args.gif, start=args.starts[-1].name)


def _train_here(args: Args, config: TrainConfig, plan: Plan, path: Path) -> int:
    from kinetix_dist.finetune.each import train_each
    from kinetix_dist.runtime import EXIT_STOPPED, StopRequested, StopSignals

    with StopSignals(limit_s=config.run.stop_seconds, hint="; the same command goes on") as stop:
        try:
            train_each(config, plan, path, report=_print_line)
        except StopRequested:
            say(f"kinetix-dist: stopped by {stop.requested}; {args.go_on}", sys.stderr)
            return EXIT_STOPPED
    return 0


def _print_line(line: str) -> None:
    print(line, flush=True)


def _draw(path: Path, gif: Path | None) -> int:
    if gif is not None:
        from kinetix_dist.cli.checks import start_computing

        start_computing()
    return _show(path, gif)


def _show(path: Path, gif: Path | None, *, start: str | None = None) -> int:
    """Prints what is stored as a table and in words, draws it and writes the card of all. start: of those in the GIF;
    None: the last."""
    from kinetix_dist.atomic_files import replace_file
    from kinetix_dist.finetune.card import overview_of
    from kinetix_dist.finetune.comparison import comparison
    from kinetix_dist.finetune.results import draw
    from kinetix_dist.stored_specialists import FROM_SCRATCH, best_of_levels, read_results

    records = read_results(path)
    lines = comparison([record for record in records if start is None or record["start"] in (start, FROM_SCRATCH)])
    say("\n".join((_table(records), *lines)), sys.stdout)
    with user_errors(OSError, prefix="the picture cannot be written: "):
        draw(records, path / PICTURE_NAME)
        replace_file(path / CARD_NAME, overview_of(records, path).encode(), is_shared=True)
    print(f"picture  {path / PICTURE_NAME}")
    print(f"cards    {path / CARD_NAME}")
    if gif is not None:
        start = start or records[-1]["start"]
        _write_gif(gif, path, best_of_levels([record for record in records if record["start"] == start]))
    return 0


def _write_gif(file: Path, path: Path, records: Sequence[Record]) -> None:
    from kinetix_dist.finetune.moving_picture import MAX_LEVELS, play_specialists, write_moving_picture

    scenes = play_specialists(path, records)
    with user_errors(OSError, prefix=f"{file} cannot be written: "):
        write_moving_picture(file, scenes)
    some = f" (the first {MAX_LEVELS} of {len(records)} levels)" if len(records) > MAX_LEVELS else ""
    print(f"gif      {file}{some}")


def _table(records: Sequence[Record]) -> str:
    from rich.console import Console
    from rich.table import Table

    from kinetix_dist.finetune.results import THRESHOLDS

    table = Table(title="Specialists: solve rates, and environment steps to them")
    table.add_column("level", no_wrap=True)
    table.add_column("start", no_wrap=True)
    table.add_column("seed", justify="right", no_wrap=True)
    columns = ("before", *(f"to {threshold:.0%}" for threshold in THRESHOLDS), "end, % (95 %)", "seconds")
    for header in columns:
        table.add_column(header, justify="right", no_wrap=True)
    for record in records:
        final, before = record["final"], record["curve"][0]
        steps = [record["env_steps_to"][str(threshold)] for threshold in THRESHOLDS]
        table.add_row(
            record["level"],
            record["label"],
            str(record["seed"]),
            f"{before['solved'] / before['attempts']:.0%}",
            *("-" if count is None else f"{count:,}" for count in steps),
            f"{100 * final['rate']:.0f} ({100 * final['low']:.0f}-{100 * final['high']:.0f})",
            f"{record['seconds']['training'] + record['seconds']['evaluation']:.0f}",
        )
    console = Console(width=MAX_TABLE_WIDTH)
    with console.capture() as captured:
        console.print(table)
    return captured.get().rstrip("\n")
