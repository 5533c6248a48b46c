"""Evaluations of the runs of a study, from their run directories."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from kinetix_dist.level.level_data import base_levels
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.run_files import METRICS, last_row
from kinetix_dist.study.plan import Plan
from kinetix_dist.sweep.arms import Run
from kinetix_dist.sweep.results_directory import directory_of
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row

PHASES = ("before", "training", "after")  # of evaluations of the policy; "random_policy" is none


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One evaluation of a run on a level set."""

    number: int  # 0: before training
    update: int
    env_steps: int
    solved: tuple[int, ...]  # attempts that solved each level
    attempts: int  # at each level

    @property
    def rate(self) -> float:
        return sum(self.solved) / (len(self.solved) * self.attempts)

    @property
    def rates(self) -> list[float]:
        """Rate of each level."""
        return [count / self.attempts for count in self.solved]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record:
    """Points of a run on one level set, by number."""

    run: Run
    level_set: str
    names: tuple[str, ...]  # of the levels
    points: Mapping[int, Point]

    @property
    def base_levels(self) -> list[str]:
        return base_levels(self.level_set, self.names)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """Training of a run so far."""

    env_steps: int = 0
    seconds: float = 0.0  # of training, warm-up included
    warmup_seconds: float = 0.0

    @property
    def steps_per_second(self) -> float | None:
        """Environment steps per second without warm-up; None where too little was trained to say."""
        trained = self.seconds - self.warmup_seconds
        return self.env_steps / trained if self.env_steps and trained > 1.0 else None


def read_progress(path: Path, run: Run) -> Progress:
    """Progress of a run of the study in `path`. Raises RunFileError."""
    row = last_row(directory_of(path, run) / METRICS, is_row=is_metrics_row).row or {}
    return Progress(
        env_steps=int(row.get("progress/env_steps", 0)),
        seconds=float(row.get("progress/seconds", 0.0)),
        warmup_seconds=float(row.get("progress/warmup_seconds", 0.0)),
    )


def read_records(path: Path, plan: Plan, run: Run) -> dict[str, Record]:
    """Records of a run by level set, of those that were evaluated. Raises RunFileError."""
    every = plan.updates_between(run)
    sets = evaluations(directory_of(path, run))["sets"]
    records = {}
    for level_set in plan.study.sets_of(run.arm.name):
        if level_set not in sets:
            continue
        points = {
            point["update"] // every: Point(
                number=point["update"] // every,
                update=point["update"],
                env_steps=point["env_steps"],
                solved=tuple(point["solved"]),
                attempts=point["attempts"],
            )
            for point in sets[level_set]["points"]
            if point["phase"] in PHASES and point["solved"] is not None and point["update"] % every == 0
        }
        names = tuple(sets[level_set]["names"])
        records[level_set] = Record(run=run, level_set=level_set, names=names, points=points)
    return records


def is_complete(path: Path, plan: Plan, run: Run) -> bool:
    """True where a run was evaluated on all sets at its end."""
    records = read_records(path, plan, run)
    last, sets = plan.last_point(run), plan.study.sets_of(run.arm.name)
    return all(level_set in records and last in records[level_set].points for level_set in sets)
