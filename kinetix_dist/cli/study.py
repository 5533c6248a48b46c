"""`kinetix-dist study NAME [--plan]`: trains the arms of a study and says what came out; `study list` names all.

The same command goes on where it stopped. docs/studies.md describes studies, their files and their results.
"""

from __future__ import annotations

import dataclasses
import functools
import shlex
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from kinetix_dist.cli.checks import check_output_directory
from kinetix_dist.cli.sweep_tables import console
from kinetix_dist.cli.worker_slots import check_machine, planned_slots, slots_for, slots_of_machine, train_in_time
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.study.command_file import CommandStudy
    from kinetix_dist.study.command_plan import CommandPlan, CommandStudyDirectory
    from kinetix_dist.study.driver import TrainingStudyDirectory
    from kinetix_dist.study.plan import Plan
    from kinetix_dist.study.study_file import Study
    from kinetix_dist.sweep.slots import Slot

    AnyDirectory = TrainingStudyDirectory | CommandStudyDirectory

RUNS = Path("runs") / "studies"
LIST = "list"
OPTION = "--gpus"


@dataclasses.dataclass(frozen=True)
class Args:
    """Train the arms of a study, and say what came out; or list all studies."""

    study: tyro.conf.Positional[str]
    """Name of a study, a file of your own (NAME.toml), or `list`: docs/studies.md."""
    plan: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print arms, slots and predicted minutes; train nothing."""
    draw: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Write the results again from what was trained; train nothing."""
    small: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """The version of seconds on a CPU, which shows that the study works."""
    minutes: float | None = None
    """Wall time that this may take; left out: as long as it takes. What is running then is stopped and saved."""
    gpus: int = 0
    """Runs at a time, one a GPU, or on CPUs one for as many cores; 0: all free GPUs, on CPUs one."""
    seeds: int | None = None
    """Seeds of each arm; left out: as many as the study says. More can be added later."""
    arms: tuple[str, ...] = ()
    """Arms to train now; left out: all."""
    out: Path | None = None
    """Directory of the results; left out: runs/studies/NAME."""


def run(args: Args) -> int:
    import jax

    from kinetix_dist.study.library import find_study
    from kinetix_dist.sweep.design import DesignError
    from kinetix_dist.sweep.results_directory import check_design

    if args.study == LIST:
        return _list(args)
    if args.plan and args.draw:
        raise UserError("--plan and --draw are both given; leave one of them out")
    check_machine(args.minutes, args.gpus, OPTION)
    jax.config.update("jax_platforms", "cpu")  # level sets are read here, and a GPU in use by this process is no slot
    with user_errors(DesignError):
        study = find_study(args.study)
        study = study.as_small if args.small else study
        path = args.out or RUNS / study.name
        if args.out is not None:
            check_output_directory(args.out, "--out")
        directory = _directory_of(study, args, path)
    is_there = check_design(path, directory.plan.hash)
    if args.draw:
        if not is_there:
            raise UserError(f"{path} holds no results of study {study.name}; train it first, or name them with --out")
        _report(directory)
        return 0
    if args.plan:
        slots, missing = planned_slots(lambda: _slots(directory, args.gpus), args.gpus, OPTION)
        return _print_plan(args, directory, slots, missing)
    return _train(args, directory, _slots(directory, args.gpus))


def _directory_of(study: Study | CommandStudy, args: Args, path: Path) -> AnyDirectory:
    """Raises DesignError for what cannot be run."""
    from kinetix_dist.study.command_file import CommandStudy
    from kinetix_dist.study.command_plan import CommandStudyDirectory, command_plan_of
    from kinetix_dist.study.driver import TrainingStudyDirectory
    from kinetix_dist.study.plan import plan_of

    if isinstance(study, CommandStudy):
        return CommandStudyDirectory(command_plan_of(study, seeds=args.seeds, arms=args.arms, path=path), path)
    return TrainingStudyDirectory(plan_of(study, seeds=args.seeds, arms=args.arms, path=path), path)


def _list(args: Args) -> int:
    from rich.table import Table

    from kinetix_dist.study.library import find_study, study_names

    if args != Args(study=LIST, out=args.out):
        raise UserError("`kinetix-dist study list` takes --out alone, the directory that holds those of the studies")
    table = Table(title="Studies", show_lines=True)
    for name in ("study", "the paper", "ours", "state", "minutes"):
        table.add_column(name, justify="right" if name == "minutes" else "left")
    for name in study_names():
        study = find_study(name)
        known = _known(study, args.out or RUNS)
        table.add_row(name, study.paper, known["finding"], known["state"], known["minutes"])
    console().print(table)
    return 0


def _known(study: Study | CommandStudy, directory: Path) -> dict[str, str]:
    """Finding of a study: of its results below a directory, or, where there are none, of its file."""
    from kinetix_dist.study.directory import read_results
    from kinetix_dist.study.study_file import NOT_RUN

    path = directory / study.name
    with user_errors(ValueError, prefix=f"{path}: "):
        found: dict[str, Any] = read_results(path) or {}
    return {
        "finding": study.finding if found.get("finding", NOT_RUN) == NOT_RUN else str(found["finding"]),
        "state": str(found.get("state", NOT_RUN if study.finding == NOT_RUN else "not run here")),
        "minutes": str(found.get("minutes", 0)),
    }


def _print_plan(args: Args, directory: AnyDirectory, slots: list[Slot], missing: str) -> int:
    """missing: why these slots are not there."""
    from kinetix_dist.study.command_plan import CommandPlan
    from kinetix_dist.study.cost import check_minutes, predicted_minutes

    plan = directory.plan
    study = plan.study
    screen = console()
    screen.print(_plan_table(plan))
    left = directory.seconds_left()
    minutes = predicted_minutes(list(left.values()), len(slots))
    lines = [
        f"question   {study.question}",
        f"the paper  {study.paper}",
        f"runs       {len(left)} of {len(plan.chosen)} are left",
        f"slots      {', '.join(slot.name for slot in slots)}" + (f"; not there now: {missing}" if missing else ""),
        f"time       {minutes:.1f} minutes predicted, {sum(left.values()) / 60:.1f} of all slots together, by the "
        f"speed of {study.cost.device} or of the arm's own runs",
        f"results    {directory.path}, hash {plan.hash}",
    ]
    if not isinstance(plan, CommandPlan):
        lines.insert(2, f"sets       {', '.join(plan.study.sets)}, every {plan.study.every_steps:,} steps")
    for line in lines:
        screen.print(line, soft_wrap=True, highlight=False)
    if args.minutes is not None:
        check_minutes(list(left.values()), args.minutes)
    return 0


def _train(args: Args, directory: AnyDirectory, slots: list[Slot]) -> int:
    from kinetix_dist.study.command_plan import CommandPlan
    from kinetix_dist.study.cost import check_minutes, predicted_minutes

    began = time.monotonic()
    left = list(directory.seconds_left().values())
    if args.minutes is not None:  # before a directory is made
        check_minutes(left, args.minutes)
    path, plan = directory.path, directory.plan
    with directory.taken():
        print(f"study {path}  hash {plan.hash}  slots {', '.join(slot.name for slot in slots)}", flush=True)
        print(f"cost       {len(left)} runs, {predicted_minutes(left, len(slots)):.1f} minutes predicted", flush=True)
        if not isinstance(plan, CommandPlan):
            print(f"watch it   kinetix-dist dashboard {shlex.quote(str(path / 'arms'))}", flush=True)
        train, finish = functools.partial(directory.train, slots), functools.partial(_report, directory)
        return train_in_time(train, directory.seconds_to_stop(), args.minutes, began, finish)


def _report(directory: AnyDirectory) -> None:
    """Writes the results and prints the paragraph."""
    files = directory.write()
    text = next(file for file in files if file.suffix == ".md").read_text()
    console().print(text, soft_wrap=True, highlight=False, markup=False)
    print(f"written    {', '.join(map(str, files))}")


def _slots(directory: AnyDirectory, requested: int) -> list[Slot]:
    """Worker slots. Raises UserError where there are none."""
    from kinetix_dist.study.command_plan import CommandPlan

    plan = directory.plan
    if isinstance(plan, CommandPlan):
        return slots_of_machine(requested, OPTION, needs_gpu=plan.study.needs_gpu)
    return slots_for(plan.runs, requested, OPTION)


def _plan_table(plan: Plan | CommandPlan) -> Any:
    """Arms of a plan, with the seeds that are chosen."""
    from kinetix_dist.study.command_plan import CommandPlan
    from kinetix_dist.study.report import in_millions

    if isinstance(plan, CommandPlan):
        title = f"{plan.study.name}: {len(plan.chosen)} times `kinetix-dist {' '.join(plan.study.command)}`"
        return _arms_table(title, "values", {arm.name: arm.values for arm in plan.study.arms}, _seeds(plan))
    study = plan.study
    title = f"{study.name}: {len(plan.chosen)} runs of recipe {study.recipe}"
    steps = {arm.name: {"steps": in_millions(study.env_steps_of(arm.name))} for arm in study.arms}
    return _arms_table(title, "options", {arm.name: arm.options for arm in study.arms}, _seeds(plan), steps)


def _seeds(plan: Plan | CommandPlan) -> dict[str, list[int]]:
    """Seeds of the chosen runs of each arm."""
    found: dict[str, list[int]] = {}
    for run in plan.chosen:
        seeds = found.setdefault(run.arm if isinstance(run.arm, str) else run.arm.name, [])
        if run.seed not in seeds:
            seeds.append(run.seed)
    return found


def _arms_table(
    title: str,
    what: str,
    arms: Mapping[str, Mapping[str, Any]],
    seeds: Mapping[str, list[int]],
    more: Mapping[str, Mapping[str, str]] | None = None,
) -> Any:
    """what: arms have besides their names. more: cells of other columns, by arm and column."""
    from rich.table import Table

    table = Table(title=title)
    columns = list(next(iter(more.values()))) if more else []
    for column in ("arm", "seeds", *columns, what):
        table.add_column(column)
    for name, values in arms.items():
        own = " ".join(map(str, seeds.get(name, ())))
        cells = [more[name][column] for column in columns] if more else []
        shown = ", ".join(f"{key} {_shown(key, value)}" for key, value in values.items())
        table.add_row(name, own or "-", *cells, shown or "-")
    return table


def _shown(option: str, value: Any) -> str:
    """A value; of phases how many."""
    from kinetix_dist.sweep.arms import PHASES

    return f"({len(value)})" if option == PHASES else str(value)
