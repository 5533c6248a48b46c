"""Results of a study in numbers: each arm on each set, at the end and over training, and the differences to one arm.

Intervals are over seeds, by bootstrap, where an arm has two or more; with one seed they are over base levels, and say
nothing of seeds. A sample that came out alike gives no interval: `NO_SPREAD`. Where arms are trained for different
steps, each has its own end, and differences over training are over the steps that both have.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from kinetix_dist.evaluation.intervals import NO_SPREAD, interval_over_levels
from kinetix_dist.evaluation.over_seeds import bootstrap_difference, bootstrap_interval, iqm, mean, welch_interval
from kinetix_dist.evaluation.paired_levels import difference_over_levels
from kinetix_dist.evaluation.summary import worst_share
from kinetix_dist.study.learnability import Refresh, read_refreshes
from kinetix_dist.study.plan import Plan
from kinetix_dist.study.records import Point, Record, is_complete, read_progress, read_records
from kinetix_dist.study.study_file import LEARNABILITY
from kinetix_dist.sweep.arms import Run

OVER_SEEDS, OVER_LEVELS, NO_INTERVAL = "seeds", "base levels", "nothing"  # samples of an interval

Rates = Callable[[Record], Sequence[float]]  # rates of levels of a record


@dataclasses.dataclass(frozen=True, kw_only=True)
class Estimate:
    """A rate or a difference, between -1 and 1, with its 95 % interval."""

    value: float
    low: float | None
    high: float | None
    over: str  # what the interval is over
    welch: tuple[float, float] | None = None  # of a difference over seeds, by Welch's t


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmResult:
    """One arm on one set. Only complete runs count."""

    arm: str
    level_set: str
    num_seeds: int
    last: Estimate  # mean over seeds after the last environment step
    last_iqm: Estimate
    worst_tenth: float  # of the levels, mean over seeds
    over_training: Estimate  # mean of all evaluations but the first
    difference: Estimate | None  # to the reference, of `last`; None: for the reference, or where that is missing
    difference_over_training: Estimate | None  # of evaluations at steps that both have


@dataclasses.dataclass(frozen=True, kw_only=True)
class Unfinished:
    """A run that does not count, and how far it is."""

    run: Run
    env_steps: int


@dataclasses.dataclass(frozen=True, kw_only=True)
class Summary:
    """Results of a study so far."""

    records: tuple[Record, ...]  # of all runs, complete or not
    results: tuple[ArmResult, ...]  # set by set, arms in the order of the study
    unfinished: tuple[Unfinished, ...]
    gaps: tuple[str, ...]  # names of complete runs that lack evaluations before the end
    refreshes: tuple[Refresh, ...] = ()  # of all runs, where the figure is about learnability


def summarise(path: Path, plan: Plan) -> Summary:
    """Summary of the results in `path`. Raises RunFileError."""
    study = plan.study
    by_run = {run.name: read_records(path, plan, run) for run in plan.runs}
    complete = [run for run in plan.runs if is_complete(path, plan, run)]
    results = []
    for level_set in study.sets:
        by_arm = {
            arm.name: [by_run[run.name][level_set] for run in complete if run.arm.name == arm.name]
            for arm in study.arms
            if level_set in study.sets_of(arm.name)
        }
        reference = by_arm.get(study.reference, [])
        for arm, records in by_arm.items():
            if records:
                results.append(_result(plan, records, [] if arm == study.reference else reference))
    gaps = [run.name for run in complete if any(_has_gaps(plan, record) for record in by_run[run.name].values())]
    left = [run for run in plan.runs if run not in complete]
    return Summary(
        records=tuple(record for run in plan.runs for record in by_run[run.name].values()),
        results=tuple(results),
        unfinished=tuple(Unfinished(run=run, env_steps=read_progress(path, run).env_steps) for run in left),
        gaps=tuple(gaps),
        refreshes=read_refreshes(path, plan) if study.figure.kind == LEARNABILITY else (),
    )


def _has_gaps(plan: Plan, record: Record) -> bool:
    return record.points.keys() < set(range(plan.last_point(record.run) + 1))


def _result(plan: Plan, records: Sequence[Record], reference: Sequence[Record]) -> ArmResult:
    def at_the_end(record: Record) -> Sequence[float]:
        return record.points[plan.last_point(record.run)].rates

    def over_training(record: Record) -> Sequence[float]:
        return np.mean([point.rates for number, point in record.points.items() if number], axis=0).tolist()

    def while_both_train(record: Record) -> Sequence[float]:
        return np.mean([point.rates for number, point in record.points.items() if 0 < number <= both], axis=0).tolist()

    both = min(plan.last_point(record.run) for record in (*records, *reference))
    ends = [record.points[plan.last_point(record.run)] for record in records]
    return ArmResult(
        arm=records[0].run.arm.name,
        level_set=records[0].level_set,
        num_seeds=len(records),
        last=estimate_at(ends, records[0].base_levels),
        last_iqm=over_seeds([point.rate for point in ends], iqm),
        worst_tenth=float(np.mean([worst_share(point.solved, point.attempts) for point in ends])),
        over_training=over_seeds([float(np.mean(over_training(record))) for record in records], mean),
        difference=_difference(records, reference, at_the_end),
        difference_over_training=_difference(records, reference, while_both_train),
    )


def estimate_at(points: Sequence[Point], base_levels: Sequence[str]) -> Estimate:
    """Mean rate of evaluations of the same levels, one a seed; with one seed its interval is over base levels."""
    if len(points) > 1:
        return over_seeds([point.rate for point in points], mean)
    (only,) = points
    found = interval_over_levels(only.solved, only.attempts, base_levels)
    if found is None:
        return Estimate(value=only.rate, low=None, high=None, over=NO_INTERVAL)
    return Estimate(value=only.rate, low=found["low"], high=found["high"], over=OVER_LEVELS)


def over_seeds(values: Sequence[float], statistic: Callable[[np.ndarray], np.ndarray]) -> Estimate:
    """A statistic of one value a seed."""
    value, interval = float(statistic(np.asarray(values, float))), bootstrap_interval(values, statistic)
    if interval is None:
        return _without_interval(value, len(values))
    return Estimate(value=value, low=interval[0], high=interval[1], over=OVER_SEEDS)


def _without_interval(value: float, num_samples: int) -> Estimate:
    """Return an estimate that has no interval. num_samples: seeds or base levels that came out alike, or fewer than
    two."""
    return Estimate(value=value, low=None, high=None, over=NO_SPREAD if num_samples > 1 else NO_INTERVAL)


def _difference(records: Sequence[Record], reference: Sequence[Record], rates: Rates) -> Estimate | None:
    """Difference of mean rates; over levels, which are the same ones, where either arm has one seed."""
    if not reference:
        return None
    ours = [float(np.mean(rates(record))) for record in records]
    theirs = [float(np.mean(rates(record))) for record in reference]
    interval = bootstrap_difference(ours, theirs)
    value = float(np.mean(ours) - np.mean(theirs))
    if interval is not None:
        low, high = interval
        return Estimate(value=value, low=low, high=high, over=OVER_SEEDS, welch=welch_interval(ours, theirs))
    if (num_seeds := min(len(ours), len(theirs))) > 1:
        return _without_interval(value, num_seeds)
    ours_by_level, theirs_by_level = (
        np.mean([rates(record) for record in each], axis=0).tolist() for each in (records, reference)
    )
    found = difference_over_levels(ours_by_level, theirs_by_level, records[0].base_levels)
    if found is None:
        return _without_interval(value, len(set(records[0].base_levels)))
    return Estimate(value=value, low=found[1], high=found[2], over=OVER_LEVELS)
