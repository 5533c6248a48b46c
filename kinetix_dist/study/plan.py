"""Runs of a study: each arm with each seed, and which of them are to be trained now."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from pathlib import Path

from kinetix_dist.config import ConfigError, TrainConfig, to_dict
from kinetix_dist.errors import one_line
from kinetix_dist.evaluation.evaluation_sets import check_evaluation_sets
from kinetix_dist.recipes import recipe
from kinetix_dist.study.choice import check_arms, seeds_in, seeds_to_run
from kinetix_dist.study.study_file import FORGETTING, Study
from kinetix_dist.sweep.arms import (
    SET_BY_SWEEP,
    Arm,
    Run,
    check_options,
    digests_of,
    make_run,
    seed_by_seed,
    short_hash,
)
from kinetix_dist.sweep.design import DesignError

# Options that no arm sets, and which field of the study says them instead.
SET_BY_STUDY = {
    **SET_BY_SWEEP,
    "evaluation.sets": "sets says it",
    "evaluation.attempts": "attempts says it",
    "evaluation.every": "every_steps says it",
    "evaluation.every_seconds": "evaluations are by environment steps",
    "run.max_seconds": "env_steps says it",
    "run.total_env_steps": "env_steps says it",
}
WITHIN = 0.05  # of every_steps, the distance between two evaluations of an arm
# Fields that change neither a number of a run nor where it is evaluated. More seeds go on in the same directory.
NO_NUMBERS = ("question", "paper", "finding", "seeds", "cost", "figure", "small", "reference")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """A study with its runs."""

    study: Study
    runs: tuple[Run, ...]  # all arms with all seeds, in the order in which they begin
    chosen: tuple[Run, ...]  # those to be trained now
    hash: str

    def updates_between(self, run: Run) -> int:
        """Updates from one evaluation of a run to the next."""
        return run.config.evaluation.every

    def last_point(self, run: Run) -> int:
        """Number of the evaluation at the end of a run."""
        return self.study.num_points_of(run.arm.name)


def plan_of(study: Study, *, seeds: int | None = None, arms: Collection[str] = (), path: Path | None = None) -> Plan:
    """Plan with so many seeds (None: as many as the study says) for the named arms (none: all). Runs that lie in `path`
    are part of the study, too, so that results never leave them out.

    The first seed of all arms comes first, then the next. Raises DesignError for what cannot be run, in one line.
    """
    check_arms(arms, [arm.name for arm in study.arms], f"unknown arm {{name}} of study {study.name}")
    base = _base(study)
    first = study.first_seed
    wanted = seeds_to_run(first, study.seeds, seeds)
    made = [Arm(name=arm.name, options={**study.options, **arm.options}) for arm in study.arms]
    first_runs = [_run(study, base, arm, first) for arm in made]
    _check_sets(first_runs)
    if study.figure.kind == FORGETTING:
        for run in first_runs:
            _check_phases(study, run)
    runs = seed_by_seed(first_runs, sorted({*wanted, *seeds_in(path)}))
    chosen = [run for run in runs if run.seed in wanted and (not arms or run.arm.name in arms)]
    return Plan(study=study, runs=tuple(runs), chosen=tuple(chosen), hash=_hash(study, first_runs))


def _base(study: Study) -> TrainConfig:
    try:
        return recipe(study.recipe)
    except ConfigError as error:
        raise DesignError(one_line(error)) from error


def _run(study: Study, base: TrainConfig, arm: Arm, seed: int) -> Run:
    check_options(arm, base, {name: f"cannot be set in a study: {why}" for name, why in SET_BY_STUDY.items()})
    forced = {
        "evaluation.sets": list(study.sets_of(arm.name)),
        "evaluation.attempts": study.attempts,
        "evaluation.every_seconds": 0.0,
        "recording.num_rollouts": 0,
        "recording.every": 0,
        "run.name": study.name,
        "run.max_seconds": 0.0,
    }
    # Of what the arm makes of a batch comes how many updates lie between two evaluations.
    any_length = {"evaluation.every": 1, "run.total_env_steps": study.env_steps_of(arm.name)}
    steps = make_run(base, arm, seed, {**forced, **any_length}).config.rollout.steps_per_update
    every = _updates_between_points(study, steps, arm.name)
    length = {"evaluation.every": every, "run.total_env_steps": study.num_points_of(arm.name) * every * steps}
    return make_run(base, arm, seed, {**forced, **length})


def _updates_between_points(study: Study, steps_per_update: int, arm: str) -> int:
    """Updates from one evaluation to the next. Raises DesignError where arms would be compared at other steps."""
    updates = max(1, round(study.every_steps / steps_per_update))
    if not math.isclose(updates * steps_per_update, study.every_steps, rel_tol=WITHIN):
        raise DesignError(
            f"arm {arm} plays {steps_per_update:,} environment steps in an update, of which no whole number is within "
            f"{WITHIN:.0%} of every_steps {study.every_steps:,}; change one"
        )
    return updates


def _check_sets(runs: Sequence[Run]) -> None:
    """Raises DesignError for level sets that are not there, or that an arm cannot play."""
    configs = [run.config for run in runs]
    for sets, size, network in {(each.evaluation.sets, each.env.size, each.policy.network) for each in configs}:
        try:
            check_evaluation_sets(sets, size, network)
        except (ValueError, OSError) as error:
            raise DesignError(f"sets: {one_line(error)}") from error


def _check_phases(study: Study, run: Run) -> None:
    """Raises DesignError for an arm whose phases are not the tasks, or do not end with an evaluation. An arm without
    phases is one that learns everything at once."""
    phases, every, tasks = run.config.schedule.phases, run.config.evaluation.every, study.figure.tasks
    if len(phases) > 1 and len(phases) != len(tasks):
        raise DesignError(
            f"arm {run.arm.name} has {len(phases)} phases, the one that it begins with included, and figure.tasks "
            f"{len(tasks)} sets; give as many"
        )
    for phase in phases:
        if phase.first_update % every:
            steps = every * run.config.rollout.steps_per_update
            raise DesignError(
                f"arm {run.arm.name}: phase {phase.number} begins after {phase.first_update} updates, between two "
                f"evaluations, which are {every} apart; let it start at a multiple of {steps:,} environment steps"
            )
        if phase.env_steps >= run.config.run.total_env_steps:
            raise DesignError(
                f"arm {run.arm.name}: phase {phase.number} begins after {phase.env_steps:,} environment steps, and the "
                f"run ends at {run.config.run.total_env_steps:,}; raise env_steps, or start it earlier"
            )


def _hash(study: Study, runs: Sequence[Run]) -> str:
    """Hash over everything that results depend on. runs: of the first seed."""
    content = {name: value for name, value in to_dict(study).items() if name not in NO_NUMBERS}
    for arm in content["arms"]:
        for name in ("env_steps", "sets"):
            if not arm[name]:  # as in results from before arms had their own, which go on
                del arm[name]
    return short_hash([content, {run.name: run.config.hash for run in runs}, digests_of(study.sets)])
