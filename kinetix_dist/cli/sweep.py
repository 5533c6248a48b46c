"""`kinetix-dist sweep DESIGN.toml --minutes N [--plan]`: arms over the free GPUs or over CPU cores, and their effects.

The same command goes on where it stopped. docs/sweeps.md describes designs and results.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from kinetix_dist.cli.streams import say
from kinetix_dist.cli.sweep_tables import arms_table, console, effects_table, print_aliases, scores_table
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.sweep.arms import Run
    from kinetix_dist.sweep.design import Design
    from kinetix_dist.sweep.driver import Sweep
    from kinetix_dist.sweep.slots import Slot

RUNS = Path("runs")
PICTURE = "sweep.png"
PATIENCE_S = 30.0  # beyond the time that runs have to stop, for results to be written


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
    from kinetix_dist.sweep.driver import check_design
    from kinetix_dist.sweep.slots import Slot

    if args.minutes is not None and not args.minutes > 0:
        raise UserError(f"--minutes is {args.minutes:g}; give a number above 0")
    if args.slots < 0:
        raise UserError(f"--slots is {args.slots}; give a number of 1 or more, or 0")
    if sys.platform != "linux":
        raise UserError(f"a sweep holds its runs to worker slots by means of Linux; this is {sys.platform}")
    with user_errors(DesignError):
        design = read_design(args.design)
    with user_errors(DesignError, prefix=f"{args.design}: "):
        runs = runs_of(design)
    path = args.out or RUNS / design.name
    check_design(path, hash_of(design, runs))
    if not args.plan:
        return _train(args, design, runs, _slots(runs, args.slots), path)
    try:
        return _print_plan(args, design, runs, _slots(runs, args.slots), path)
    except _TooFewDevicesError as error:
        if not args.slots:
            raise UserError(f"{error}; --slots N plans for N of them") from error
        slots = [Slot(name=f"gpu {number}", gpu=str(number)) for number in range(args.slots)]
        return _print_plan(args, design, runs, slots, path, missing=str(error))


class _TooFewDevicesError(UserError):
    """Devices are missing on this machine, or are not free now."""


def _slots(runs: list[Run], requested: int) -> list[Slot]:
    """Raises UserError for arms that cannot run in any slot, then _TooFewDevicesError."""
    from kinetix_dist.runtime import PlacementError, count_gpus, plan_placement, resolve_device
    from kinetix_dist.sweep.slots import cpu_slots, gpu_slots

    if "RAY_ADDRESS" in os.environ:
        raise UserError("RAY_ADDRESS is set, but arms run on this machine, each in a Ray of its own; unset it")
    num_gpus = count_gpus()
    devices = set()
    for one in runs:
        with user_errors(PlacementError, ValueError, prefix=f"arm {one.arm.name}: "):
            # A slot has one GPU; the check that there is any comes below.
            device = resolve_device(one.config.run.device, num_gpus=max(num_gpus, one.config.run.device == "gpu"))
            devices.add(device)
            if one.config.run.placement != "local":
                plan_placement(one.config, num_gpus=int(device == "gpu"))
    if len(devices) > 1:
        raise UserError("some arms run on GPUs and some on CPUs; give all the same run.device")
    if devices == {"cpu"}:
        return cpu_slots(requested)
    if not num_gpus:
        raise _TooFewDevicesError("arms are to run on GPUs (run.device), but no GPU is visible here")
    try:
        return gpu_slots(requested)
    except UserError as error:
        raise _TooFewDevicesError(str(error)) from error


def _print_plan(
    args: Args, design: Design, runs: list[Run], slots: list[Slot], path: Path, *, missing: str = ""
) -> int:
    """missing: why these slots are not there."""
    from kinetix_dist.sweep.arms import hash_of
    from kinetix_dist.sweep.driver import done_so_far
    from kinetix_dist.sweep.rungs import check_fits, predicted_seconds, stage_sizes

    screen = console()
    screen.print(arms_table(design, runs))
    if design.factorial is not None:
        print_aliases(screen, design)
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
    from kinetix_dist.runtime import EXIT_STOPPED, StopSignals
    from kinetix_dist.sweep.driver import RunsFailedError, Sweep, SweepStoppedError, done_so_far, seconds_to_stop
    from kinetix_dist.sweep.rungs import check_fits

    began = time.monotonic()
    if args.minutes is not None:  # before a directory is made
        check_fits(design, done_so_far(path, runs), len(slots), args.minutes)
    sweep = Sweep(design, runs, path)
    hint = "; the same command goes on"
    # A second signal ends this process at once, and its runs by the signal that they get then.
    with StopSignals(limit_s=seconds_to_stop(runs) + PATIENCE_S, hint=hint) as stop, stop.deferred():

        def must_stop() -> str | None:
            if stop.requested is not None:
                return f"stopped by {stop.requested}"
            is_over = args.minutes is not None and time.monotonic() - began > 60 * args.minutes
            return f"stopped after {args.minutes:g} minutes" if is_over else None

        print(f"sweep {path}  hash {sweep.hash}  slots {', '.join(slot.name for slot in slots)}", flush=True)
        print(f"watch it   kinetix-dist dashboard {shlex.quote(str(path / 'arms'))}", flush=True)
        status = 0
        try:
            sweep.train(slots, report=_print_line, must_stop=must_stop)
        except SweepStoppedError as error:
            say(f"kinetix-dist: {error}{hint}", sys.stderr)
            status = EXIT_STOPPED
        except RunsFailedError as error:
            say(f"kinetix-dist: {error}{hint} with these", sys.stderr)
            status = 1
        finally:
            sweep.close()
        _report(sweep)
    return status


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


def _print_line(line: str) -> None:
    print(time.strftime("%H:%M:%S"), line, flush=True)
