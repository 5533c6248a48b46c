"""`kinetix-dist sweep DESIGN.toml --minutes N [--plan]`: arms over the free GPUs or over CPU cores, and their effects.

The same command goes on where it stopped. docs/sweeps.md describes designs and results.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from kinetix_dist.cli.checks import check_output_directory
from kinetix_dist.cli.sweep_tables import arms_table, console, effects_table, print_aliases, scores_table
from kinetix_dist.cli.worker_slots import check_machine, planned_slots, slots_for, train_in_time
from kinetix_dist.errors import user_errors

if TYPE_CHECKING:
    from kinetix_dist.sweep.arms import Run
    from kinetix_dist.sweep.design import Design
    from kinetix_dist.sweep.driver import Sweep
    from kinetix_dist.sweep.slots import Slot

RUNS = Path("runs")
PICTURE = "sweep.png"
OPTION = "--slots"


@dataclasses.dataclass(frozen=True)
class Args:
    """Train the arms of a design, and say what their factors are worth."""

    design: tyro.conf.Positional[Path]
    """The design file, TOML: docs/sweeps.md."""
    minutes: float | None = None
    """Wall time that this may take; left out: as long as it takes. What is running then is stopped and saved."""
    plan: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print arms, slots, time and aliases; train nothing."""
    slots: int = 0
    """Runs at a time, one a GPU, or on CPUs one for as many cores; 0: all free GPUs, on CPUs one."""
    out: Path | None = None
    """Directory of the results; left out: runs/NAME."""


def run(args: Args) -> int:
    from kinetix_dist.sweep.arms import hash_of, runs_of
    from kinetix_dist.sweep.design import DesignError, read_design
    from kinetix_dist.sweep.results_directory import check_design

    check_machine(args.minutes, args.slots, OPTION)
    with user_errors(DesignError):
        design = read_design(args.design)
    with user_errors(DesignError, prefix=f"{args.design}: "):
        runs = runs_of(design)
    path = args.out or RUNS / design.name
    if args.out is not None:
        check_output_directory(args.out, "--out")
    check_design(path, hash_of(design, runs))
    if args.plan:
        slots, missing = planned_slots(lambda: slots_for(runs, args.slots, OPTION), args.slots, OPTION)
        return _print_plan(args, design, runs, slots, path, missing=missing)
    return _train(args, design, runs, slots_for(runs, args.slots, OPTION), path)


def _print_plan(
    args: Args, design: Design, runs: list[Run], slots: list[Slot], path: Path, *, missing: str = ""
) -> int:
    """missing: why these slots are not there."""
    from kinetix_dist.sweep.arms import hash_of
    from kinetix_dist.sweep.results_directory import done_so_far
    from kinetix_dist.sweep.rungs import check_fits, predicted_seconds, stage_sizes

    screen = console()
    screen.print(arms_table(design, runs))
    if design.factorial is not None:
        print_aliases(screen, design.factorial)
    sets = ", ".join(f"{name} x {weight:g}" for name, weight in design.objective.sets.items())
    done = done_so_far(path, runs)
    minutes = predicted_seconds(design, list(done.values()), len(slots)) / 60
    lines = [
        f"objective  {sets}, every {design.objective.every_seconds:g} s of training from second "
        f"{design.objective.from_second:g} on",
        *(f"rung       {count} runs until second {until:g}" for count, until in stage_sizes(design, len(runs))),
        f"slots      {', '.join(slot.name for slot in slots)}" + (f"; not there now: {missing}" if missing else ""),
        f"time       {minutes:.1f} minutes predicted for what is left, {design.start_seconds:g} s a run not training",
        f"results    {path}, hash {hash_of(design, runs)}",
    ]
    for line in lines:
        screen.print(line, soft_wrap=True, highlight=False)
    if args.minutes is not None:
        check_fits(design, done, len(slots), args.minutes)
    return 0


def _train(args: Args, design: Design, runs: list[Run], slots: list[Slot], path: Path) -> int:
    from kinetix_dist.sweep.driver import Sweep
    from kinetix_dist.sweep.results_directory import done_so_far
    from kinetix_dist.sweep.rungs import check_fits
    from kinetix_dist.sweep.training_work import seconds_to_stop

    began = time.monotonic()
    if args.minutes is not None:  # before a directory is made
        check_fits(design, done_so_far(path, runs), len(slots), args.minutes)
    sweep = Sweep(design, runs, path)
    print(f"sweep {path}  hash {sweep.hash}  slots {', '.join(slot.name for slot in slots)}", flush=True)
    print(f"watch it   kinetix-dist dashboard {shlex.quote(str(path / 'arms'))}", flush=True)
    try:
        train, finish = functools.partial(sweep.train, slots), functools.partial(_report, sweep)
        return train_in_time(train, seconds_to_stop(runs), args.minutes, began, finish)
    finally:
        sweep.close()


def _report(sweep: Sweep) -> None:
    """Tables and the picture, from sweep.json."""
    from kinetix_dist.sweep.driver import RESULTS
    from kinetix_dist.sweep.results import draw

    found = json.loads((sweep.path / RESULTS).read_text())
    screen = console()
    if found["arms"]:
        screen.print(scores_table(found))
    if found["effects"] is not None:
        screen.print(effects_table(found["effects"]))
    if found["arms"]:
        draw(found, sweep.path / PICTURE)
        print(f"written    {sweep.path / RESULTS}, {sweep.path / PICTURE}")
