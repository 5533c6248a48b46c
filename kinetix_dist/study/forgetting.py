"""Forgetting of an arm that learns task after task, phase by phase.

    R[i, j]             solve rate on set j after phase i; R[0, j] before training
    t(j), s(j)          the last and the first phase that trains for set j; T phases in all

    average rate        mean of R[T, j]                        over all sets that a phase trains for
    forgetting          mean of max_{1 <= l < T} R[l, j] - R[T, j]   over those that the last phase does not train for
    backward transfer   mean of R[T, j] - R[t(j), j]           over the same
    forward transfer    mean of R[s(j) - 1, j] - R[0, j]       over those that the first phase does not train for

Forgetting is that of Chaudhry et al. 2018 (section 3.2), the transfers are those of Lopez-Paz & Ranzato 2017 (section
2), to which these reduce where every phase has a set of its own. An arm without phases learns everything at once: it
has an average rate alone.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from kinetix_dist.evaluation.over_seeds import mean
from kinetix_dist.study.plan import Plan
from kinetix_dist.study.records import Point, Record
from kinetix_dist.study.summary import Estimate, Summary, over_seeds
from kinetix_dist.sweep.arms import Run

MEASURES = ("average rate", "forgetting", "backward transfer", "forward transfer")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Trained:
    """A complete run: evaluations before training and at the end of each phase."""

    run: Run
    tasks: tuple[str, ...]  # of its phases; (): it has none
    points: tuple[Mapping[str, Point], ...]  # by set: before training, after each phase

    def rates(self, sets: Sequence[str]) -> np.ndarray:
        """[1 + phases, sets] R."""
        return np.array([[row[name].rate for name in sets] for row in self.points])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Forgetting:
    """One arm, over its seeds."""

    arm: str
    tasks: tuple[str, ...]  # of its phases; (): it has none
    sets: tuple[str, ...]  # of its evaluations
    rates: np.ndarray  # [1 + phases, sets] R, mean over seeds
    measures: Mapping[str, Estimate]  # those of `MEASURES` that it has


def trained_runs(plan: Plan, summary: Summary) -> list[Trained]:
    """Runs that are complete, in the order of the plan. Those that lack an evaluation at the end of a phase are left
    out: `Summary.gaps` names them."""
    unfinished = {each.run.name for each in summary.unfinished}
    by_run: dict[str, dict[str, Record]] = {}
    for record in summary.records:
        by_run.setdefault(record.run.name, {})[record.level_set] = record
    found = []
    for run in plan.runs:
        if run.name in unfinished:
            continue
        phases, every = run.config.schedule.phases, plan.updates_between(run)
        ends = [*(phase.first_update // every for phase in phases), plan.last_point(run)]
        if any(end not in record.points for record in by_run[run.name].values() for end in ends):
            continue
        points = tuple({name: record.points[end] for name, record in by_run[run.name].items()} for end in ends)
        found.append(Trained(run=run, tasks=plan.study.figure.tasks if len(phases) > 1 else (), points=points))
    return found


def forgetting(plan: Plan, runs: Sequence[Trained]) -> list[Forgetting]:
    """Results of the arms that have complete runs, in the order of the study."""
    results = []
    for arm in plan.study.arms:
        own = [each for each in runs if each.run.arm.name == arm.name]
        if not own:
            continue
        measured = [measures(each, plan.study.figure.tasks) for each in own]
        results.append(
            Forgetting(
                arm=arm.name,
                tasks=own[0].tasks,
                sets=plan.study.sets_of(arm.name),
                rates=np.mean([each.rates(plan.study.sets_of(arm.name)) for each in own], axis=0),
                measures={
                    name: over_seeds([each[name] for each in measured], mean)
                    for name in MEASURES
                    if name in measured[0]
                },
            )
        )
    return results


def measures(trained: Trained, tasks: Sequence[str]) -> dict[str, float]:
    """Values of the `MEASURES` that a run has, by name. tasks: of the study."""
    sets = list(dict.fromkeys(tasks))
    rates = trained.rates(sets)
    found = {"average rate": float(rates[-1].mean())}
    own = trained.tasks
    first = {name: own.index(name) + 1 for name in sets if name in own}
    last = {name: len(own) - own[::-1].index(name) for name in sets if name in own}
    if earlier := [j for j, name in enumerate(sets) if last.get(name, len(own)) < len(own)]:
        found["forgetting"] = float(np.mean([rates[1:-1, j].max() - rates[-1, j] for j in earlier]))
        found["backward transfer"] = float(np.mean([rates[-1, j] - rates[last[sets[j]], j] for j in earlier]))
    if later := [j for j, name in enumerate(sets) if first.get(name, 1) > 1]:
        found["forward transfer"] = float(np.mean([rates[first[sets[j]] - 1, j] - rates[0, j] for j in later]))
    return found
