"""Predicted wall time of a study: environment steps that are left, by the speed of each arm."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from kinetix_dist.errors import UserError
from kinetix_dist.study.plan import Plan
from kinetix_dist.study.records import is_complete, read_progress
from kinetix_dist.sweep.arms import Run
from kinetix_dist.sweep.rungs import makespan


def seconds_left(path: Path, plan: Plan) -> dict[str, float]:
    """Predicted seconds of each chosen run that is not complete, by its name in the order in which they begin.

    The speed is that of the arm's runs in `path`, or the one that the file of the study gives.
    """
    speeds = _speeds(path, plan)
    left = {}
    for run in plan.chosen:
        if not is_complete(path, plan, run):
            steps = max(run.config.run.total_env_steps - read_progress(path, run).env_steps, 0)
            left[run.name] = plan.study.cost.start_seconds + steps / speeds[run.arm.name]
    return left


def predicted_minutes(left: Sequence[float], num_slots: int) -> float:
    """Minutes until all have ended, each begun in the first free slot."""
    return makespan(left, num_slots) / 60


def check_minutes(left: Sequence[float], minutes: float) -> None:
    """Raises UserError where the minutes are not enough for any run that is left."""
    if left and min(left) > 60 * minutes:
        needed = min(left) / 60
        raise UserError(
            f"--minutes is {minutes:g}, and one run takes {needed:.1f} minutes; give --minutes {needed:.1f} or more"
        )


def _speeds(path: Path, plan: Plan) -> dict[str, float]:
    """Environment steps per second of each arm."""
    measured: dict[str, list[float]] = {}
    for run in plan.runs:
        if (speed := read_progress(path, run).steps_per_second) is not None:
            measured.setdefault(run.arm.name, []).append(speed)
    return {
        run.arm.name: statistics.median(measured.get(run.arm.name, [plan.study.cost.steps_per_second]))
        for run in plan.runs
    }


def trained_minutes(path: Path, runs: Sequence[Run]) -> float:
    """Minutes of training that all runs have had together."""
    return sum(read_progress(path, run).seconds for run in runs) / 60
