"""Objective of a sweep: weighted solve rates over seconds of training, from the files of a run.

    evaluations.jsonl (solved levels after k updates) + metrics.jsonl (seconds after k updates) -> curve -> area, last

Seconds are those of training after its warm-up (`progress/seconds` less `progress/warmup_seconds`): arms compile for
different times, and the second of two alike finds the programs of the first in the cache.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from kinetix_dist.level.level import SIZES
from kinetix_dist.level.level_data import designed_files, designed_sets
from kinetix_dist.level.sets import RANDOM_SETS, development_sets, files_of_set, is_public_level, size_of_drawn_set
from kinetix_dist.studio.runs.evaluations import evaluations
from kinetix_dist.studio.runs.run_files import METRICS, last_row
from kinetix_dist.sweep.design import DesignError, Objective
from kinetix_dist.telemetry.json_lines import read_lines
from kinetix_dist.telemetry.sinks.jsonl import is_metrics_row

LAST_VALUES = 3  # of the curve, whose mean is the second objective


@dataclasses.dataclass(frozen=True, kw_only=True)
class Curve:
    """The objective of one run over time."""

    updates: np.ndarray  # [points] done by the policies that were evaluated
    seconds: np.ndarray  # [points] of training after its warm-up, rising
    values: np.ndarray  # [points] weighted mean of solve rates
    rates: Mapping[str, np.ndarray]  # [points] of each level set

    def reaches(self, second: float) -> bool:
        """True where there is an evaluation at or after it."""
        return len(self.seconds) > 0 and bool(self.seconds[-1] >= second)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Score:
    """Objectives of one run."""

    area: float  # mean of the curve over its span
    last: float  # mean of its last values


def training_seconds(row: Mapping[str, float]) -> float:
    """Seconds of training at a row of metrics, without warm-up."""
    return row["progress/seconds"] - row["progress/warmup_seconds"]


def seconds_so_far(run: Path) -> float:
    """Seconds of training after its warm-up, by the last row of metrics; 0 where there is none."""
    row = last_row(run / METRICS, is_row=is_metrics_row).row
    return training_seconds(row) if row is not None and "progress/warmup_seconds" in row else 0.0


def read_curve(run: Path, objective: Objective) -> Curve:
    """Curve of a run directory so far. An evaluation without a row of metrics of its update (a disk that was full) is
    left out. Raises RunFileError where a file cannot be read."""
    rows = read_lines(run / METRICS, is_metrics_row).rows
    seconds_at = {row["update"]: training_seconds(row) for row in rows if "progress/warmup_seconds" in row}
    seconds_at[0] = 0.0
    sets = evaluations(run)["sets"]
    by_set = {
        name: {p["update"]: p["rate"] for p in sets[name]["points"] if p["phase"] in ("before", "training")}
        for name in objective.sets
        if name in sets
    }
    updates = sorted(set(seconds_at).intersection(*by_set.values()) if len(by_set) == len(objective.sets) else ())
    rates = {name: np.array([points[update] for update in updates]) for name, points in by_set.items()}
    total = sum(objective.sets.values())
    return Curve(
        updates=np.array(updates, int),
        seconds=np.array([seconds_at[update] for update in updates]),
        values=sum((weight * rates[name] for name, weight in objective.sets.items()), np.zeros(len(updates))) / total
        if updates
        else np.zeros(0),
        rates=rates,
    )


def score(curve: Curve, objective: Objective, until: float) -> Score:
    """Score of the curve from `objective.from_second` until a second that it reaches."""
    last = int(np.searchsorted(curve.seconds, until)) + 1  # evaluations up to the first one at or after it
    return Score(
        area=area(curve.seconds, curve.values, objective.from_second, until),
        last=float(curve.values[:last][-LAST_VALUES:].mean()),
    )


def area(x: np.ndarray, y: np.ndarray, start: float, end: float) -> float:
    """Mean over [start, end] of y, linear between points: the area by trapezia, divided by the span.

    x: [n] rising. Raises ValueError where the points do not reach from start to end.
    """
    if not len(x) or x[0] > start or x[-1] < end or not start < end:
        raise ValueError(f"points from {x[:1]} to {x[-1:]} do not span {start:g} to {end:g}")
    inside = (x > start) & (x < end)
    xs = np.r_[start, x[inside], end]
    return float(np.trapezoid(np.interp(xs, x, y), xs) / (end - start))


def check_sets(names: Collection[str], sizes: Collection[str]) -> None:
    """Raises DesignError for level sets that cannot be an objective of arms of these sizes."""
    for name in names:
        _check_set(name)
        order = list(SIZES)
        for size in sizes:
            needed = size_of_drawn_set(name) or size
            if order.index(needed) > order.index(size):
                raise DesignError(f"level set {name} does not fit arms of env.size {size!r}; choose another")


def _check_set(name: str) -> None:
    choice = f"choose of {', '.join(development_sets())}, or level files of your own"
    if name in development_sets():
        return
    if name in RANDOM_SETS or name in designed_sets() or designed_files(name):
        raise DesignError(
            f"{name} cannot be an objective: results are reported on it, and would be too good then; {choice}"
        )
    try:
        public = [file for file in files_of_set(name) if is_public_level(file)]
    except (ValueError, OSError) as error:
        raise DesignError(f"objective.sets: {error}") from error
    if public:
        raise DesignError(
            f"public levels cannot be an objective: {public[0]} is one, and published results are compared on them; "
            f"{choice}"
        )
