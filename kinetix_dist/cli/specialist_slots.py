"""Specialists over worker slots: `kinetix-dist finetune --each --slots N`.

    this process      holds the directory of results, gives each slot a part of what is to be trained, computes nothing
    a slot            `kinetix-dist finetune --each --part K/N` on a GPU or some cores: many specialists in a program
    both              write into one directory; a specialist is done where its figures are

The loop is that of sweeps (`sweep/run_loop.py`), and so are slots: one GPU each, as many as are free.
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from kinetix_dist.cli.streams import say
from kinetix_dist.cli.worker_slots import slots_of_machine, train_in_time
from kinetix_dist.errors import UserError, user_errors

if TYPE_CHECKING:
    from kinetix_dist.config import TrainConfig
    from kinetix_dist.finetune.each import Plan
    from kinetix_dist.finetune.results import Key
    from kinetix_dist.sweep.slots import Slot

OPTION = "--slots"
STOP_GRACE_S = 30.0  # beyond run.stop_seconds, at which a process ends itself wherever it is
REPORT_EVERY_S = 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Part:
    """Share of the specialists, which one slot trains."""

    name: str
    words: tuple[str, ...]  # of `kinetix-dist`
    keys: tuple[Key, ...]


def check_slots(requested: int) -> None:
    """Raises UserError for a number of slots that is none, and on systems that cannot hold processes to slots."""
    if requested < 0:
        raise UserError(f"{OPTION} is {requested}; give a number of 1 or more, or 0 for all free GPUs")
    if sys.platform != "linux":
        raise UserError(f"{OPTION} holds processes to devices by means of Linux; this is {sys.platform}")


def hold_to_cpu() -> None:
    """Keeps JAX in this process off the GPUs, which the slots are to have. Comes before anything is computed."""
    import jax

    jax.config.update("jax_platforms", "cpu")


def slots_of(config: TrainConfig, requested: int) -> list[Slot]:
    """Worker slots for a configuration: GPUs, or CPU cores by `run.device`. Raises UserError where there are none."""
    from kinetix_dist.runtime import PlacementError, count_gpus, resolve_device
    from kinetix_dist.sweep.slots import cpu_slots

    with user_errors(PlacementError, ValueError):
        device = resolve_device(config.run.device, num_gpus=max(count_gpus(), config.run.device == "gpu"))
    return cpu_slots(requested, OPTION) if device == "cpu" else slots_of_machine(requested, OPTION, needs_gpu=True)


def train_in_slots(config: TrainConfig, plan: Plan, path: Path, words: Sequence[str], slots: Sequence[Slot]) -> int:
    """Trains what is left in worker slots, one part each; returns the exit status. words: of the command that trains
    all of it in one process."""
    from kinetix_dist.finetune.each import prepare
    from kinetix_dist.finetune.results import ResultsDirectory
    from kinetix_dist.sweep.results_directory import LOGS
    from kinetix_dist.sweep.run_loop import Callbacks, RunLoop, RunsFailedError

    prepared = prepare(config, plan)
    parts = parts_of(plan, prepared.names, words, len(slots))
    began = time.monotonic()
    results = ResultsDirectory(path, prepared.design, is_parent=True)
    try:
        with user_errors(OSError, prefix=f"{path} cannot be written: "):
            (path / LOGS).mkdir(exist_ok=True)
        all_keys = [key for part in parts for key in part.keys]
        watched = _Watched(path, all_keys)
        if num_done := len(all_keys) - len(watched.missing):
            say(f"{num_done} of {len(all_keys)} specialists are there already", sys.stdout)
        work = _Parts(path, config.run.stop_seconds + STOP_GRACE_S)

        def train(*, report: Callable[[str], None], must_stop: Callable[[], str | None]) -> None:
            def polled() -> str | None:
                watched.report(report)
                return must_stop()

            if failures := RunLoop(path, work, work, Callbacks(report=report, must_stop=polled)).train(parts, slots):
                raise RunsFailedError("; ".join(failures))
            watched.report(report, at_once=True)

        return train_in_time(train, work.stop_s, None, began, lambda: None)
    finally:
        results.close()


def parts_of(plan: Plan, names: Sequence[str], words: Sequence[str], count: int) -> list[Part]:
    """Parts of the plan, as many as slots, without those that have none of its specialists."""
    number, of = plan.part
    found = []
    for slot in range(count):
        part = (number + of * slot, of * count)
        keys = dataclasses.replace(plan, part=part).keys(names)
        if keys:
            name = f"part-{part[0]}-of-{part[1]}"
            own = ("finetune", *words, "--part", f"{part[0]}/{part[1]}")
            found.append(Part(name=name, words=own, keys=tuple(keys)))
    return found


@dataclasses.dataclass(frozen=True)
class _Parts:
    """Parts as work of `run_loop.py`, and the figures of their specialists as its goal."""

    path: Path
    stop_s: float

    def command(self, part: Part) -> tuple[list[str], bool]:
        return list(part.words), bool(self._num_done(part))

    def seconds_to_stop(self, part: Part) -> float:
        del part
        return self.stop_s

    def ended(self, part: Part, status: int) -> str:
        del part, status
        return ""

    def is_reached(self, part: Part) -> bool:
        return self._num_done(part) == len(part.keys)

    def must_end(self, part: Part) -> bool:
        del part
        return False

    def why_out_of_reach(self, part: Part) -> str:
        return f"{part.name} was stopped before its end"

    def result(self, part: Part) -> str:
        return f"{len(part.keys)} specialists"

    def _num_done(self, part: Part) -> int:
        from kinetix_dist.finetune.results import file_of

        return sum(file_of(self.path, key).exists() for key in part.keys)


class _Watched:
    """Specialists that are still to come, each said once it is there."""

    def __init__(self, path: Path, keys: Sequence[Key]) -> None:
        from kinetix_dist.finetune.results import file_of

        self._count = len(keys)
        self.missing = [file for key in keys if not (file := file_of(path, key)).exists()]
        self._looked = 0.0  # s of time.monotonic()

    def report(self, report: Callable[[str], None], *, at_once: bool = False) -> None:
        from kinetix_dist.finetune.each import summary
        from kinetix_dist.stored_specialists import read_stored

        if not at_once and time.monotonic() - self._looked < REPORT_EVERY_S:
            return
        self._looked = time.monotonic()
        for file in [file for file in self.missing if file.exists()]:
            self.missing.remove(file)
            report(f"{self._count - len(self.missing)}/{self._count}  {summary(read_stored(file))}")
