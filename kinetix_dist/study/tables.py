"""Results of a study as CSV: a row per arm, seed, set and point; of one about levels or learnability, a row per level
or refresh; of one about forgetting, rates after each phase and the numbers that follow from them."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from typing import Any

from kinetix_dist.evaluation.summary import worst_share
from kinetix_dist.study.forgetting import MEASURES, Trained, measures
from kinetix_dist.study.learnability import KINDS, Refresh
from kinetix_dist.study.records import Record

COLUMNS = ("arm", "seed", "set", "point", "update", "env_steps", "solved", "attempts", "worst_tenth")


def points_csv(records: Sequence[Record]) -> str:
    """Text of NAME.csv. solved, attempts: of all levels of the set together."""
    return text_of(
        COLUMNS,
        (
            (
                record.run.arm.name,
                record.run.seed,
                record.level_set,
                point.number,
                point.update,
                point.env_steps,
                sum(point.solved),
                point.attempts * len(point.solved),
                f"{worst_share(point.solved, point.attempts):.4f}",
            )
            for record in records
            for point in record.points.values()
        ),
    )


def levels_csv(records: Sequence[Record], num_points: int) -> str:
    """Text of NAME_levels.csv: attempts that solved each level at each point; empty where an evaluation is missing.

    num_points: of the longest arm, without the one before training."""
    numbers = range(num_points + 1)
    return text_of(
        ("arm", "seed", "set", "level", "attempts", *(f"solved_at_point_{number}" for number in numbers)),
        (
            (
                record.run.arm.name,
                record.run.seed,
                record.level_set,
                name,
                next(iter(record.points.values())).attempts,
                *(record.points[number].solved[index] if number in record.points else "" for number in numbers),
            )
            for record in records
            if record.points
            for index, name in enumerate(record.names)
        ),
    )


def learnability_csv(refreshes: Iterable[Refresh]) -> str:
    """Text of NAME_learnability.csv: a row per arm, seed and refresh; empty where a number is not known."""
    return text_of(
        ("arm", "seed", "update", "env_steps", *KINDS, "learnable_share"),
        (
            (
                refresh.run.arm.name,
                refresh.run.seed,
                refresh.update,
                refresh.env_steps,
                *(_digits(getattr(refresh, kind)) for kind in KINDS),
                _digits(refresh.learnable_share),
            )
            for refresh in refreshes
        ),
    )


def forgetting_csv(runs: Sequence[Trained]) -> str:
    """Text of NAME_forgetting.csv: a row per arm, seed, phase and set; phase 0 is before training."""
    return text_of(
        ("arm", "seed", "after_phase", "trained_for", "set", "solved", "attempts"),
        (
            (
                each.run.arm.name,
                each.run.seed,
                number,
                each.tasks[number - 1] if each.tasks and number else "",
                name,
                sum(point.solved),
                point.attempts * len(point.solved),
            )
            for each in runs
            for number, row in enumerate(each.points)
            for name, point in row.items()
        ),
    )


def transfer_csv(runs: Sequence[Trained], tasks: Sequence[str]) -> str:
    """Text of NAME_transfer.csv: a row per arm and seed; empty where an arm has no phases."""
    found = [(each, measures(each, tasks)) for each in runs]
    return text_of(
        ("arm", "seed", *(name.replace(" ", "_") for name in MEASURES)),
        (
            (each.run.arm.name, each.run.seed, *(_digits(measured.get(name)) for name in MEASURES))
            for each, measured in found
        ),
    )


def _digits(value: float | None) -> str:
    return "" if value is None else f"{value:.4f}"


def text_of(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Text of a CSV file."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return text.getvalue()
