"""Worker slots of commands that train many runs, and training in them until it is done, stopped or out of time."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Protocol

from kinetix_dist.cli.streams import say
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.sweep.arms import Run
    from kinetix_dist.sweep.slots import Slot

PATIENCE_S = 30.0  # beyond the time that runs have to stop, for results to be written
HINT = "; the same command goes on"


class TooFewDevicesError(UserError):
    """Devices are missing on this machine, or are not free now."""


def check_machine(minutes: float | None, requested: int, option: str) -> None:
    """Raises UserError for arguments that are none, and where there are no worker slots."""
    if minutes is not None and not minutes > 0:
        raise UserError(f"--minutes is {minutes:g}; give a number above 0")
    if requested < 0:
        raise UserError(f"{option} is {requested}; give a number of 1 or more, or 0")
    if sys.platform != "linux":
        raise UserError(f"runs are held to worker slots by means of Linux; this is {sys.platform}")


def slots_for(runs: Sequence[Run], requested: int, option: str) -> list[Slot]:
    """Worker slots of runs. option: the flag by which `requested` was given.

    Raises UserError for arms that cannot run in any slot, then TooFewDevicesError.
    """
    from kinetix_dist.runtime import PlacementError, count_gpus, plan_placement, resolve_device
    from kinetix_dist.sweep.slots import cpu_slots

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
        return cpu_slots(requested, option)
    if not num_gpus:
        raise TooFewDevicesError("arms are to run on GPUs (run.device), but no GPU is visible here")
    return _gpu_slots(requested, option)


def slots_of_machine(requested: int, option: str, *, needs_gpu: bool) -> list[Slot]:
    """Worker slots of commands that run on GPUs where there are any. Raises TooFewDevicesError, UserError."""
    from kinetix_dist.runtime import count_gpus
    from kinetix_dist.sweep.slots import cpu_slots

    if count_gpus():
        return _gpu_slots(requested, option)
    if needs_gpu:
        raise TooFewDevicesError("arms are to run on GPUs, but no GPU is visible here")
    return cpu_slots(requested, option)


def _gpu_slots(requested: int, option: str) -> list[Slot]:
    from kinetix_dist.sweep.slots import gpu_slots

    try:
        return gpu_slots(requested, option)
    except UserError as error:
        raise TooFewDevicesError(str(error)) from error


def planned_slots(slots: Callable[[], list[Slot]], requested: int, option: str) -> tuple[list[Slot], str]:
    """(worker slots, why they are not there now; "": they are), for a plan. Raises UserError where none are named."""
    from kinetix_dist.sweep.slots import Slot

    try:
        return slots(), ""
    except TooFewDevicesError as error:
        if not requested:
            raise UserError(f"{error}; {option} N plans for N of them") from error
        return [Slot(name=f"gpu {number}", gpu=str(number)) for number in range(requested)], str(error)


class Trains(Protocol):
    """Training that may be stopped: raises RunsStoppedError and RunsFailedError of `sweep/run_loop.py`."""

    def __call__(self, *, report: Callable[[str], None], must_stop: Callable[[], str | None]) -> None: ...


def train_in_time(
    train: Trains, seconds_to_stop: float, minutes: float | None, began: float, finish: Callable[[], None]
) -> int:
    """Exit status of a command that works runs off until all are done, it is stopped or the minutes are over.

    seconds_to_stop: after which all have ended that were stopped. began: s of time.monotonic(). finish: called when
    runs have ended. A second signal ends this process at once, and its runs by the signal that they get then.
    """
    from kinetix_dist.runtime import EXIT_STOPPED, StopSignals
    from kinetix_dist.sweep.run_loop import RunsFailedError, RunsStoppedError

    with StopSignals(limit_s=seconds_to_stop + PATIENCE_S, hint=HINT) as stop, stop.deferred():

        def must_stop() -> str | None:
            if stop.requested is not None:
                return f"stopped by {stop.requested}"
            is_over = minutes is not None and time.monotonic() - began > 60 * minutes
            return f"stopped after {minutes:g} minutes" if is_over else None

        status = 0
        try:
            train(report=_print_line, must_stop=must_stop)
        except RunsStoppedError as error:
            say(f"kinetix-dist: {error}{HINT}", sys.stderr)
            status = EXIT_STOPPED
        except RunsFailedError as error:
            say(f"kinetix-dist: {error}{HINT} with these", sys.stderr)
            status = 1
        finish()
    return status


def _print_line(line: str) -> None:
    print(time.strftime("%H:%M:%S"), line, flush=True)
