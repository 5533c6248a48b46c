"""`kinetix-dist train [--recipe NAME] [--run DIR] [--resume] [--from CKPT] [--data DIR] [--section.field value ...]`:
pretrain a policy.

Without --run the directory is runs/NAME, or the next free runs/NAME-2, ...; with --resume the newest of these. --recipe
takes the directory of a run, too: a new run begins with the configuration of that one. Every field of the configuration
is an option; `--help` lists everyday ones with the values of the recipe, `--help SECTION` those of a section.
`--env.preset NAME` replaces all solver settings (env.physics) by those of a preset, `--curriculum.generator NAME` all
parameters of random levels, before single fields are overridden. `--phases FILE` replaces the phases of the recipe
after that; `--from CKPT` is short for --run.start_from, `--data DIR` for --imitation.data.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import shlex
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kinetix_dist.cli.option_help import HELP_ALL, WIDTH, options_help, wants_help
from kinetix_dist.cli.phase_options import PREFIX, override_phases, split_phase_options
from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, one_line, user_errors
from kinetix_dist.text_files import read_json_object

if TYPE_CHECKING:
    from kinetix_dist.config import RunConfig, TrainConfig
    from kinetix_dist.runtime import RunDirectory, StopSignals

RUNS = Path("runs")
CONFIG = "config.json"  # of a run
DEFAULT_RECIPE = "quickstart"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Args:
    """Command line as `parse` has read it."""

    config: TrainConfig
    run: Path | None  # None: runs/NAME, numbered
    resume: bool


def parse(
    argv: Sequence[str],
    *,
    prog: str = "kinetix-dist train",
    default_recipe: str = DEFAULT_RECIPE,
    adjust: Callable[[TrainConfig], TrainConfig] = lambda recipe: recipe,
) -> Args:
    """Options of the command itself first; the rest overrides fields of the recipe, or of the run that is resumed.

    adjust: what another command makes of the recipe, before anything is overridden. Not called for a resumed run.
    """
    own = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    own.add_argument("--recipe")
    own.add_argument("--run", type=Path)
    own.add_argument("--resume", action="store_true")
    own.add_argument("--from", dest="start_from")
    own.add_argument("--data")
    own.add_argument("--phases", type=Path)
    own.add_argument("--env.preset", dest="preset")
    own.add_argument("--curriculum.generator", dest="generator")
    own.add_argument("--run.plugins", dest="plugins", nargs="+")
    try:
        known, overrides = own.parse_known_args(list(argv))
    except argparse.ArgumentError as error:
        raise UserError(f"{one_line(error)}; see `{prog} --help`") from None
    from jax2d.settings import PRESETS, preset
    from kinetix_dist.config import with_phases
    from kinetix_dist.config.phases import read_phases
    from kinetix_dist.level.generator_config import GENERATORS, generator
    from kinetix_dist.recipes import RECIPES
    from kinetix_dist.registry import import_plugins

    if wants_help(overrides):
        recipe_name = known.recipe or default_recipe
        usage = "\n".join(
            (
                f"usage: {prog} [--recipe NAME] [--run DIR] [--resume] [--from CKPT] [--section.field value ...]\n",
                *_listed(
                    "--recipe NAME",
                    f"{', '.join(RECIPES)} (default {default_recipe}); or the directory of a run: its settings",
                ),
                "  --run DIR       directory of the run (default runs/NAME, numbered if there is one)",
                "  --resume        go on with the run in --run, or with the newest run of the recipe",
                "  --from CKPT     start from the parameters of a checkpoint, or of a pretrained policy by name",
                "  --data DIR      imitate a data set of `kinetix-dist collect` first (docs/data.md)",
                "  --phases FILE   TOML or JSON: from a step on, other settings (docs/training.md, Phases)",
                *_listed("--env.preset NAME", f"all of env.physics at once: {', '.join(PRESETS)}"),
                *_listed(
                    "--curriculum.generator NAME", f"all of curriculum.generator at once: {', '.join(GENERATORS)}"
                ),
                f"\noptions and their values in recipe {recipe_name!r}:\n",
            )
        )
        shown = recipe_or_run(recipe_name)
        if HELP_ALL not in overrides:
            text = options_help(overrides, shown, prog)
            print(f"{usage}\n{text}")
            raise SystemExit(0)
        print(usage)
        overrides = ["--help"]
    run = known.run
    if run == Path() and not known.resume:  # also what an unset variable gives
        raise UserError("--run is empty or the current directory; name a directory of the run's own, or leave it out")
    if known.resume and known.start_from is not None:
        raise UserError("--from is for a new run, and a run that is resumed goes on from its own checkpoints; give one")
    with user_errors(ValueError):
        import_plugins(known.plugins or ())  # before fields are checked, which may name parts that these register
    base = recipe_or_run(known.recipe or default_recipe)
    if known.resume:
        run, stored = _run_to_resume(run, base.run.name)
        base = stored if known.recipe is None else base
    if known.plugins is not None:
        base = dataclasses.replace(base, run=dataclasses.replace(base.run, plugins=tuple(known.plugins)))
    if not known.resume:
        base = adjust(base)
    if known.preset is not None:
        with user_errors(ValueError):
            base = dataclasses.replace(base, env=dataclasses.replace(base.env, physics=preset(known.preset)))
    if known.generator is not None:
        with user_errors(ValueError):
            curriculum = dataclasses.replace(base.curriculum, generator=generator(known.generator))
        base = dataclasses.replace(base, curriculum=curriculum)
    if known.start_from is not None:
        if not known.start_from:
            raise UserError("--from is empty; name a checkpoint or a pretrained policy, or leave it out")
        path = Path(known.start_from)  # from which directory the command was given is forgotten
        start_from = str(path.resolve()) if path.exists() else known.start_from
        base = dataclasses.replace(base, run=dataclasses.replace(base.run, start_from=start_from))
    if known.data is not None:
        if not known.data:
            raise UserError("--data is empty; name the directory of a data set, or leave it out")
        overrides = [*overrides, "--imitation.data", str(Path(known.data).resolve())]
    phases = None
    if known.phases is not None:
        if single := [word for word in overrides if word.startswith(PREFIX)]:
            raise UserError(
                f"--phases FILE has all phases, and {single[0]} is of one; change the file, or leave it out"
            )
        with user_errors(ValueError, OSError):
            phases = read_phases(known.phases)
        base = dataclasses.replace(base, phases=())
    others, of_phases = split_phase_options(overrides)
    with user_errors(ValueError):
        config = _override(dataclasses.replace(base, phases=()), others, prog)
        config = dataclasses.replace(config, phases=base.phases)
        config = override_phases(config, of_phases, lambda phase, words: _override(phase, words, prog))
    if phases is not None:  # after fields are overridden, which have to go with them
        with user_errors(ValueError, prefix=f"{known.phases}: "):
            config = with_phases(config, phases)
    with user_errors(ValueError):
        for phase in config.schedule.phases:
            phase.config.check_generator()
    return Args(config=config, run=run, resume=known.resume)


def _listed(option: str, text: str) -> list[str]:
    """Lines of an option whose values are many."""
    indent = " " * 18
    lines = textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent)
    is_short = len(option) < len(indent) - 3
    return [f"  {option:<16}{lines[0].strip()}", *lines[1:]] if is_short else [f"  {option}", *lines]


def run(args: Args) -> int:
    status, _ = run_in(args)
    return status


def run_in(args: Args) -> tuple[int, Path | None]:
    """Exit status, and the directory of the run where it came to its end."""
    from kinetix_dist.runtime import EXIT_STOPPED, RunFailedError, StoppedError, StopRequested, StopSignals

    hint = "; go on with --resume"
    with StopSignals(limit_s=args.config.run.stop_seconds, hint=hint) as stop:
        try:
            return 0, _run(args, stop)
        except RunFailedError as error:
            say(f"kinetix-dist: {one_line(error)}", sys.stderr)
            return 1, None
        except StoppedError as error:
            say(f"kinetix-dist: {one_line(error)}", sys.stderr)
            return EXIT_STOPPED, None
        except StopRequested:
            say(f"kinetix-dist: stopped by {stop.requested} before the run began", sys.stderr)
            return EXIT_STOPPED, None


def _run(args: Args, stop: StopSignals) -> Path:
    from kinetix_dist.checkpoint import CheckpointError
    from kinetix_dist.cli.checks import start_computing
    from kinetix_dist.data import DatasetError
    from kinetix_dist.env.device_memory import DeviceMemoryError
    from kinetix_dist.env.env_config import describe
    from kinetix_dist.models.kernels.support import KernelError
    from kinetix_dist.runtime import (
        PlacementError,
        RunDirectoryError,
        check_devices,
        count_gpus,
        hold_to_cpu,
        plan_placement,
        resolve_device,
        start_fork_server,
        starting_point,
        train,
    )
    from kinetix_dist.telemetry.sinks.prometheus import PortTakenError

    config = args.config
    if args.resume and _is_finished(args):
        assert args.run is not None
        return args.run
    if "RAY_ADDRESS" not in os.environ or config.run.placement == "local":
        with user_errors(PlacementError):  # before a directory is made; a cluster is checked when it is connected
            resolve_device(config.run.device, num_gpus=count_gpus())
            if config.run.placement != "local":
                plan_placement(config, num_gpus=count_gpus())
    fork_server = start_fork_server(config)
    directory, differs = None, ()
    try:
        with user_errors(PlacementError):
            hold_to_cpu(config.run)
        start_computing(config.run.compile_cache)
        with user_errors(PlacementError):
            check_devices(config)
        with user_errors(ValueError, OSError):
            _check_inputs(config, is_new=not args.resume)  # reading levels computes
        if not args.resume:
            with user_errors(CheckpointError, ValueError, OSError):
                differs = starting_point(config).differs
        with user_errors(RunDirectoryError):
            directory = _open(args)
        print(
            f"{'resuming' if args.resume else 'training'} {directory.path}  config {config.hash}"
            f"  physics {describe(config.env.physics)}",
            flush=True,
        )
        if differs:
            print(
                f"starts     from another policy than {config.run.start_from} plays: {', '.join(differs)}", flush=True
            )
        print(f"watch it   kinetix-dist dashboard {shlex.quote(str(directory.path))}", flush=True)
        with user_errors(
            CheckpointError,
            DatasetError,
            DeviceMemoryError,
            KernelError,
            PlacementError,
            PortTakenError,
            FileNotFoundError,
        ):
            report = train(config, directory, resume=args.resume, stop=stop, fork_server=fork_server)
        _print_report(report, directory.path, config.run)
        return directory.path
    finally:
        if directory is not None:
            directory.close()
        if fork_server is not None:
            fork_server.stop()


def _is_finished(args: Args) -> bool:
    """True where the run to resume is at the end that its configuration sets; says so, and how it goes on."""
    from kinetix_dist.runtime import finished_report

    assert args.run is not None
    report = finished_report(args.run, args.config)
    if report is None:
        return False
    reached = f"{report['env_steps']:,} env steps in {report['training_seconds']:.0f} s of training"
    say(f"{args.run} is finished: {reached}; {longer(args.config.run, report)} goes on", sys.stdout)
    return True


def _override(base: TrainConfig, overrides: list[str], prog: str) -> TrainConfig:
    import tyro

    from kinetix_dist.cli.main import parse_args
    from kinetix_dist.config import TrainConfig

    if not overrides:
        return base
    with user_errors(ValueError):
        return parse_args(tyro.conf.FlagConversionOff[TrainConfig], overrides, prog=prog, default=base)


def recipe_or_run(name: str) -> TrainConfig:
    """Configuration of a recipe, or that of a run whose directory is named."""
    from kinetix_dist.recipes import RECIPES, recipe

    path = Path(name) / CONFIG
    if name not in RECIPES and path.is_file():
        return _stored_config(path, is_resumed=False)
    with user_errors(ValueError):
        return recipe(name)


def _run_to_resume(run: Path | None, name: str) -> tuple[Path, TrainConfig]:
    from kinetix_dist.runtime import newest_run, no_run_in

    if run is None:
        run = newest_run(RUNS, name)
        if run is None:
            raise UserError(f"there is no run {RUNS / name} to resume; name one with --run, or leave out --resume")
    path = run / CONFIG
    if not path.is_file():
        raise UserError(no_run_in(run))
    return run, _stored_config(path, is_resumed=True)


def _stored_config(path: Path, *, is_resumed: bool) -> TrainConfig:
    """Return the configuration of a run. Whoever resumes a run trusts its plugins and paths; a recipe needs less."""
    from kinetix_dist.config import from_dict, from_dict_as_recipe

    remedy = 'the checkpoint.json of each checkpoint has the same "config"'
    content = read_json_object(path, advice=remedy)
    with user_errors(ValueError, prefix=f"{path}: "):
        try:
            if not isinstance(content["config"]["run"], dict):
                raise TypeError("its section run is no object")
            return (from_dict if is_resumed else from_dict_as_recipe)(content["config"])
        except (KeyError, TypeError, AttributeError) as error:
            raise ValueError(f"it is damaged ({type(error).__name__}: {one_line(error)}); {remedy}") from None


def _check_inputs(config: TrainConfig, *, is_new: bool) -> None:
    """Opens the data set that a new run imitates, and loads the level files of training and evaluation, so that a wrong
    name or file is found at once. Sets that are drawn need their size alone to be right, and drawing them takes
    seconds."""
    from kinetix_dist.data import open_dataset
    from kinetix_dist.evaluation.evaluation_sets import check_evaluation_sets
    from kinetix_dist.level.level import SIZES
    from kinetix_dist.level.sets import load_level_set, size_of_drawn_set

    if config.imitation.data and is_new:
        data = open_dataset(config.imitation.data, skip_damaged=config.imitation.skip_damaged)
        data.check_env(config.env)
        if data.shortfall:
            say(data.shortfall, sys.stderr)
    check_evaluation_sets(config.evaluation.sets, config.env.size, config.policy.network)
    for phase in config.schedule.phases:
        order, name, own = list(SIZES), phase.config.curriculum.levels, phase.config.env.size
        size = size_of_drawn_set(name) if name else own
        if size is None:
            load_level_set(name, own)
        elif order.index(size) > order.index(own):
            raise ValueError(f"level set {name!r} does not fit size {own!r}; choose a larger env.size")


def _open(args: Args) -> RunDirectory:
    from kinetix_dist.runtime import RunDirectory

    if args.resume:
        assert args.run is not None
        return RunDirectory.open_existing(args.run)
    if args.run is not None:
        return RunDirectory.create(args.run, numbered=False)
    return RunDirectory.create(RUNS / args.config.run.name, numbered=True)


def _print_report(report: dict[str, Any], run: Path, ended_by: RunConfig) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"Solve rates, % (95 % interval), after {report['env_steps']:,} env steps")
    table.add_column("level set")
    table.add_column("attempts", justify="right")
    names = {"random_policy": "random actions", "before": "before", "after": "after"}
    for header in names.values():
        table.add_column(header, justify="right")
    sets = report["solve_rate"]["after"]
    for name in sets:
        cells = [_cell(report["solve_rate"].get(column), name) for column in names]
        table.add_row(name, str(sets[name]["attempts"]), *cells)
    console = Console()
    with console.capture() as captured:
        console.print(table)
        seconds = report["seconds_by_role"]
        total = max(sum(seconds.values()), 1e-9)
        shares = ", ".join(f"{role} {value / total:.0%}" for role, value in seconds.items() if value / total >= 0.005)
        console.print(
            f"{report['env_steps_per_second']:,.0f} env steps/s in training, "
            f"{report['wall_seconds']:.0f} s in all ({shares})",
            highlight=False,
            soft_wrap=True,
        )
        console.print(f"written    {', '.join(_written(run))}", highlight=False, soft_wrap=True)
    path = shlex.quote(str(run))
    lines = [captured.get().rstrip("\n")]
    if any((run / "recordings").glob("*.mcap")):
        lines.append(f"replay     kinetix-dist replay {path} --view")
    lines.append(f"train on   kinetix-dist train --run {path} --resume {longer(ended_by, report)}")
    say("\n".join(lines), sys.stdout)


def longer(run: RunConfig, report: Mapping[str, Any]) -> str:
    """Options with which a run that came to its end goes on for as long again: of what ended it."""
    steps, seconds = report["env_steps"], report["training_seconds"]
    is_done = 0 < run.total_env_steps <= steps
    options = [f"--run.total_env_steps {2 * steps}"] if is_done else []
    if run.max_seconds and (seconds >= run.max_seconds or not is_done):
        options.append(f"--run.max_seconds {2 * run.max_seconds:g}")
    return " ".join(options)


def _cell(rates: dict[str, dict[str, Any]] | None, name: str) -> str:
    if rates is None or name not in rates:
        return "-"
    from kinetix_dist.evaluation.intervals import for_readers

    low, high = for_readers(rates[name])
    return f"{100 * rates[name]['rate']:.1f} ({100 * low:.1f}-{100 * high:.1f})"


def _written(run: Path) -> list[str]:
    patterns = ("report.json", "checkpoints", "metrics", "recordings/*.mcap", "recordings/*.rrd", "recordings/*.png")
    return [str(path.relative_to(run)) for pattern in patterns for path in sorted(run.glob(pattern))]
