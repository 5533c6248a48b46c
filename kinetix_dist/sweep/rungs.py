"""Rungs of a sweep: runs and the second until which they are trained. Without halving there is one, of all runs."""

from __future__ import annotations

import dataclasses
import heapq
import math
from collections.abc import Callable, Generator, Mapping, Sequence

import numpy as np

from kinetix_dist.errors import UserError
from kinetix_dist.sweep.arms import Run
from kinetix_dist.sweep.design import Design


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stage:
    """Runs to train until a second."""

    runs: tuple[Run, ...]
    seconds: float


def stages(design: Design, runs: Sequence[Run], area_of: Callable[[Run, float], float]) -> Generator[Stage]:
    """Stages, each of which has to be complete before the next is taken. area_of: the objective of a run until a
    second, by which arms stay (their mean over seeds); of equal ones the first."""
    going = list(runs)
    keeps = [rung.keep for rung in design.halving.rungs] if design.halving is not None else [0.0]
    for seconds, keep in zip(design.rung_seconds, keeps, strict=True):
        yield Stage(runs=tuple(going), seconds=seconds)
        if keep:
            arms = list(dict.fromkeys(run.arm.name for run in going))
            means = {
                arm: float(np.mean([area_of(run, seconds) for run in going if run.arm.name == arm])) for arm in arms
            }
            best = sorted(arms, key=lambda arm: -means[arm])[: num_staying(len(arms), keep)]
            going = [run for run in going if run.arm.name in best]


def num_staying(num_arms: int, keep: float) -> int:
    """Arms that go on: their share, rounded up, and at least one."""
    return max(1, math.ceil(num_arms * keep - 1e-9))


def stage_sizes(design: Design, num_runs: int) -> list[tuple[int, float]]:
    """(number of runs, second until which they are trained) of each stage to come."""
    sizes, arms = [], len(design.arms)
    for number, seconds in enumerate(design.rung_seconds):
        sizes.append((arms * len(design.seeds) if design.halving is not None else num_runs, seconds))
        if design.halving is not None:
            arms = num_staying(arms, design.halving.rungs[number].keep)
    return sizes


def predicted_seconds(design: Design, done: Sequence[float], num_slots: int) -> float:
    """Wall time of what is left. done: seconds that each run has been trained so far."""
    total, ordered = 0.0, list(done)
    for number, (count, until) in enumerate(stage_sizes(design, len(ordered))):
        if number:  # those that go on are not known: the longest trained, which they will be
            ordered = sorted(ordered, reverse=True)
        left = [until - seconds for seconds in ordered[:count] if seconds < until]
        total += makespan([design.start_seconds + seconds for seconds in left], num_slots)
        ordered = [max(seconds, until) for seconds in ordered[:count]]
    return total


def check_fits(design: Design, done: Mapping[str, float], num_slots: int, minutes: float) -> None:
    """Raises UserError, which says what fits, where the runs that are left take longer."""
    seconds = predicted_seconds(design, list(done.values()), num_slots)
    if seconds <= 60 * minutes:
        return
    left = [value for value in done.values() if value < design.rung_seconds[-1]]
    slots = f"{num_slots} slot{'s' if num_slots > 1 else ''}"
    given = f"{len(left)} runs on {slots} take {seconds / 60:.0f} minutes, and {minutes:g} are given"
    enough = f"--minutes {math.ceil(seconds / 60)}"
    if design.halving is not None:
        fitting = [
            until
            for number, until in enumerate(design.rung_seconds)
            if predicted_seconds(_until(design, number), list(done.values()), num_slots) <= 60 * minutes
        ]
        what = f"the rungs up to {fitting[-1]:g} s fit" if fitting else "not even the first rung fits"
    else:
        fit = max(
            n for n in range(len(left) + 1) if n == 0 or predicted_seconds(design, left[:n], num_slots) <= 60 * minutes
        )
        waves = math.ceil(len(left) / num_slots)
        every = design.objective.every_seconds
        shorter = (60 * minutes / waves - design.start_seconds) // every * every
        what = f"{fit} runs fit" + (
            f", or all with seconds {shorter:g}" if shorter > design.objective.from_second else ""
        )
    raise UserError(f"{given}: {what}; or give {enough} or more slots")


def _until(design: Design, last: int) -> Design:
    """The same with fewer rungs."""
    assert design.halving is not None
    rungs = design.halving.rungs[: last + 1]
    if len(rungs) == 1:
        return dataclasses.replace(design, halving=None, seconds=rungs[0].seconds)
    rungs = (*rungs[:-1], dataclasses.replace(rungs[-1], keep=0.0))
    return dataclasses.replace(design, halving=dataclasses.replace(design.halving, rungs=rungs))


def makespan(seconds: Sequence[float], num_slots: int) -> float:
    """Seconds until jobs have ended that begin in their order, each in the first free slot."""
    ends = [0.0] * num_slots
    for job in seconds:
        heapq.heapreplace(ends, ends[0] + job)
    return max(ends)
