"""Learnability p (1 - p) of the levels that a curriculum chose, and of those that it chose from, over training.

    fresh      candidates of a refresh, what levels offer that nobody chose: unbiased, from the episodes of scoring
    claimed    levels of the buffer, by the episodes for which they were chosen: too high, since the largest are kept
    measured   the same levels in training, by first episodes alone: unbiased

`studio/runs/refreshes.py` reads them from `curriculum/` of a run directory. Arms without a refresh have none.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from kinetix_dist.studio.runs.refreshes import Refreshes
from kinetix_dist.study.plan import Plan
from kinetix_dist.sweep.arms import Run
from kinetix_dist.sweep.results_directory import directory_of
from kinetix_dist.telemetry.curriculum_log import REFRESH

KINDS = ("fresh", "claimed", "measured")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refresh:
    """Learnability at one refresh of a run; None where it is not known."""

    run: Run
    update: int  # policy version that scored the candidates
    env_steps: int  # that it was trained on
    fresh: float | None
    claimed: float | None
    measured: float | None
    learnable_share: float  # of the candidates, with episodes of both kinds


def read_refreshes(path: Path, plan: Plan) -> tuple[Refresh, ...]:
    """Refreshes of all runs of the study in `path`, a run after the other, in order of updates."""
    return tuple(found for run in plan.runs for found in _of_run(path, run))


def _of_run(path: Path, run: Run) -> Iterator[Refresh]:
    for entry in Refreshes(directory_of(path, run)).summaries()["snapshots"]:
        if entry["kind"] != REFRESH:
            continue
        candidates, training = entry["candidates"], entry.get("training")
        counts = candidates["counts"]  # [[solved, finished, levels], ...]
        yield Refresh(
            run=run,
            update=entry["number"],
            env_steps=run.config.schedule.env_steps(entry["number"]),
            fresh=candidates["learnability"],
            claimed=entry["buffer"]["claimed"],
            measured=None if training is None else training["learnability"],
            learnable_share=sum(n for solved, finished, n in counts if 0 < solved < finished) / candidates["levels"],
        )


def over_seeds(refreshes: Sequence[Refresh], arm: str, kind: str) -> tuple[list[float], list[float]]:
    """(millions of environment steps, mean over the seeds of an arm that have it) of a kind, in order of steps."""
    by_steps: dict[int, list[float]] = {}
    for refresh in refreshes:
        value = getattr(refresh, kind)
        if refresh.run.arm.name == arm and value is not None:
            by_steps.setdefault(refresh.env_steps, []).append(value)
    steps = sorted(by_steps)
    return [each / 1e6 for each in steps], [float(np.mean(by_steps[each])) for each in steps]


def sentences(plan: Plan, refreshes: Sequence[Refresh]) -> list[str]:
    """Learnability of the last refresh that training has measured, a sentence an arm."""
    found = []
    for arm in plan.study.arms:
        steps, measured = over_seeds(refreshes, arm.name, "measured")
        if not steps:
            continue
        last = [each for each in refreshes if each.run.arm.name == arm.name and each.env_steps / 1e6 == steps[-1]]
        values = {kind: dict(zip(*over_seeds(refreshes, arm.name, kind), strict=True)) for kind in KINDS}
        fresh = values["fresh"].get(steps[-1])
        of_fresh = "" if fresh is None else f", of fresh levels {fresh:.3f}"
        share = float(np.mean([each.learnable_share for each in last]))
        found.append(
            f"{arm.name} after {steps[-1]:,.0f} M steps: learnability of its buffer "
            f"{values['claimed'][steps[-1]]:.3f} claimed and {measured[-1]:.3f} measured in training{of_fresh}; "
            f"{share:.0%} of its candidates were solved in some of their episodes and not in all."
        )
    return found
