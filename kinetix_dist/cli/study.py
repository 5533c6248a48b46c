"""`kinetix-dist study NAME [--plan]`: trains the arms of a study and says what came out; `study list` names all.

The same command goes on where it stopped. docs/studies.md describes studies, their files and their results.
"""

from __future__ import annotations

import dataclasses
import functools
import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from kinetix_dist.cli.sweep_tables import console
from kinetix_dist.cli.worker_slots import check_machine, planned_slots, slots_for, train_in_time
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.study.plan import Plan
    from kinetix_dist.study.study_file import Study
    from kinetix_dist.sweep.slots import Slot

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
    from kinetix_dist.study.plan import plan_of
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
        plan = plan_of(study, seeds=args.seeds, arms=args.arms, path=path)
    is_there = check_design(path, plan.hash)
    if args.draw:
        if not is_there:
            raise UserError(f"{path} holds no results of study {study.name}; train it first, or name them with --out")
        _report(plan, path)
        return 0
    if args.plan:
        slots, missing = planned_slots(plan.runs, args.gpus, OPTION)
        return _print_plan(args, plan, slots, path, missing)
    return _train(args, plan, slots_for(plan.runs, args.gpus, OPTION), path)


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


def _known(study: Study, directory: Path) -> dict[str, str]:
    """What the results of a study below a directory show; where there are none, what the file of the study says."""
    from kinetix_dist.study.driver import read_results
    from kinetix_dist.study.study_file import NOT_RUN

    path = directory / study.name
    with user_errors(ValueError, prefix=f"{path}: "):
        found: dict[str, Any] = read_results(path) or {}
    return {
        "finding": study.finding if found.get("finding", NOT_RUN) == NOT_RUN else str(found["finding"]),
        "state": str(found.get("state", NOT_RUN)),
        "minutes": str(found.get("minutes", 0)),
    }


def _print_plan(args: Args, plan: Plan, slots: list[Slot], path: Path, missing: str) -> int:
    """missing: why these slots are not there."""
    from kinetix_dist.study.cost import check_minutes, predicted_minutes, seconds_left
    from kinetix_dist.study.report import in_millions

    study = plan.study
    screen = console()
    screen.print(_arms_table(plan))
    left = seconds_left(path, plan)
    minutes = predicted_minutes(list(left.values()), len(slots))
    lines = [
        f"question   {study.question}",
        f"the paper  {study.paper}",
        f"sets       {', '.join(study.sets)}, {study.num_points} times in {in_millions(study.env_steps)} steps",
        f"runs       {len(left)} of {len(plan.chosen)} are left",
        f"slots      {', '.join(slot.name for slot in slots)}" + (f"; not there now: {missing}" if missing else ""),
        f"time       {minutes:.1f} minutes predicted, {sum(left.values()) / 60:.1f} of all slots together, by the "
        f"speed of {study.cost.device} or of the arm's own runs",
        f"results    {path}, hash {plan.hash}",
    ]
    for line in lines:
        screen.print(line, soft_wrap=True, highlight=False)
    if args.minutes is not None:
        check_minutes(list(left.values()), args.minutes)
    return 0


def _arms_table(plan: Plan) -> Any:
    from rich.table import Table

    table = Table(title=f"{plan.study.name}: {len(plan.chosen)} runs of recipe {plan.study.recipe}")
    for name in ("arm", "seeds", "options"):
        table.add_column(name)
    for arm in plan.study.arms:
        seeds = " ".join(str(run.seed) for run in plan.chosen if run.arm.name == arm.name)
        table.add_row(
            arm.name, seeds or "-", ", ".join(f"{name} {value}" for name, value in arm.options.items()) or "-"
        )
    return table


def _train(args: Args, plan: Plan, slots: list[Slot], path: Path) -> int:
    from kinetix_dist.study.cost import check_minutes, predicted_minutes, seconds_left
    from kinetix_dist.study.driver import StudyTraining

    began = time.monotonic()
    left = list(seconds_left(path, plan).values())
    if args.minutes is not None:  # before a directory is made
        check_minutes(left, args.minutes)
    training = StudyTraining(plan, path)
    print(f"study {path}  hash {plan.hash}  slots {', '.join(slot.name for slot in slots)}", flush=True)
    print(f"cost       {len(left)} runs, {predicted_minutes(left, len(slots)):.1f} minutes predicted", flush=True)
    print(f"watch it   kinetix-dist dashboard {shlex.quote(str(path / 'arms'))}", flush=True)
    try:
        train, finish = functools.partial(training.train, slots), functools.partial(_report, plan, path)
        return train_in_time(train, plan.chosen, args.minutes, began, finish)
    finally:
        training.close()


def _report(plan: Plan, path: Path) -> None:
    """Writes the results and prints the paragraph."""
    from kinetix_dist.study.driver import write_results

    files = write_results(path, plan)
    text = next(file for file in files if file.suffix == ".md").read_text()
    console().print(text, soft_wrap=True, highlight=False, markup=False)
    print(f"written    {', '.join(map(str, files))}")
