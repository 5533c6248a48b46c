"""Arms of a design and their runs: changed options, configuration, and the command that trains each."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.atomic_files import replace_file
from kinetix_dist.config import ConfigError, TrainConfig, flat, from_dict, to_dict
from kinetix_dist.errors import one_line
from kinetix_dist.json_text import json_text
from kinetix_dist.level.sets import files_of_set, size_of_drawn_set
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.recipes import recipe
from kinetix_dist.renamed_settings import RenamedSettingError, refuse_old_options
from kinetix_dist.sweep.design import Design, DesignError, Options
from kinetix_dist.sweep.factorial import TwoLevelDesign, two_level_design
from kinetix_dist.sweep.objective import check_sets

MAX_ARMS = 512
PHASES = "phases"  # the option that is a list of tables
# A run has to have an end of its own. The sweep stops it long before.
MAX_RUN_SECONDS = 7 * 24 * 3600.0
# Options that no arm sets, and why.
SET_BY_SWEEP = {
    "evaluation.sets": "objective.sets says it",
    "evaluation.every": "objective.every_seconds says it",
    "evaluation.every_seconds": "objective.every_seconds says it",
    "recording.every": "arms record no rollouts",
    "recording.num_rollouts": "arms record no rollouts",
    "run.max_seconds": "seconds says it",
    "run.total_env_steps": "seconds says it",
    "run.seed": "seeds says it",
    "run.name": "name says it",
    "run.num_workers": "an arm has one device",
    "run.metrics_port": "arms would share it",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Arm:
    """One setting of all options."""

    name: str
    options: Options  # besides the recipe
    levels: Mapping[str, int] = dataclasses.field(default_factory=dict)  # -1 or 1 of each factor
    is_fold_over: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """One training run: an arm with a seed."""

    arm: Arm
    seed: int
    options: Options  # everything that differs from the recipe
    config: TrainConfig

    @property
    def name(self) -> str:
        """Name of its directory."""
        return f"{self.arm.name}-seed{self.seed}"


def arms_of(design: Design) -> list[Arm]:
    """All arms; those of a factorial are named a1, a2, ... in standard order, those of its fold-over b1, b2, ..."""
    if design.factorial is None:
        return [Arm(name=arm.name, options={**design.options, **arm.options}) for arm in design.arms]
    plan = two_level_design(design.factorial)
    if len(plan.levels) > MAX_ARMS:
        raise DesignError(
            f"factorial has {len(plan.levels)} arms; at most {MAX_ARMS} can be run: give factors generators"
        )
    return [_factorial_arm(design, plan, row) for row in range(len(plan.levels))]


def _factorial_arm(design: Design, plan: TwoLevelDesign, row: int) -> Arm:
    assert design.factorial is not None
    levels = dict(zip(plan.names, plan.levels[row].tolist(), strict=True))
    options = dict(design.options)
    for factor in design.factorial.factors:
        options |= factor.high if levels[factor.name] > 0 else factor.low
    half = 2**plan.num_basic
    name = f"{'ab'[row // half]}{row % half + 1}"
    return Arm(name=name, options=options, levels=levels, is_fold_over=row >= half)


def runs_of(design: Design) -> list[Run]:
    """Runs in the order in which they begin: the first seed of all arms, then the next; a fold-over comes last.

    Raises DesignError for a recipe, an option, a value or a level set that cannot be used.
    """
    try:
        base = recipe(design.recipe)
    except ConfigError as error:
        raise DesignError(one_line(error)) from error
    arms, runs = arms_of(design), []
    for is_fold_over, seeds in ((False, design.seeds), (True, design.fold_over_seeds)):
        half = [_run(design, base, arm, seeds[0]) for arm in arms if arm.is_fold_over == is_fold_over]
        runs += seed_by_seed(half, seeds)
    check_sets(design.objective.sets, {run.config.env.size for run in runs})
    for run in runs:
        if run.config.curriculum.name == "fixed" and run.config.curriculum.levels in design.objective.sets:
            raise DesignError(
                f"arm {run.arm.name} trains on {run.config.curriculum.levels}, which is part of the objective; "
                "change one"
            )
    return runs


def seed_by_seed(first: Sequence[Run], seeds: Sequence[int]) -> list[Run]:
    """Return runs of all arms with all seeds: the first seed of all arms, then the next. first: a run of each arm."""
    return [run for of_seed in zip(*(with_seeds(run, seeds) for run in first), strict=True) for run in of_seed]


def _run(design: Design, base: TrainConfig, arm: Arm, seed: int) -> Run:
    forced = {
        "evaluation.sets": list(design.objective.sets),
        "evaluation.every": 0,
        "evaluation.every_seconds": float(design.objective.every_seconds),
        "recording.num_rollouts": 0,
        "recording.every": 0,
        "run.name": design.name,
        "run.total_env_steps": 0,
        "run.max_seconds": MAX_RUN_SECONDS,
    }
    check_options(arm, base, {name: f"cannot be set in a sweep: {why}" for name, why in SET_BY_SWEEP.items()})
    return make_run(base, arm, seed, forced)


def check_options(arm: Arm, base: TrainConfig, refused: Mapping[str, str]) -> None:
    """Raises DesignError for an option of an arm that is unknown or `refused`: name -> predicate of the complaint."""
    known = flat(to_dict(base))
    for name in arm.options:
        if name in refused:
            raise DesignError(f"option {name} {refused[name]}")
        try:
            refuse_old_options({name: arm.options[name]})
        except RenamedSettingError as error:
            raise DesignError(f"arm {arm.name}: {error}") from None
        if name not in known:
            hint = did_you_mean(name, known, "`kinetix-dist train --help-all` lists all")
            raise DesignError(f"unknown option {name!r} of arm {arm.name}; {hint}")


def make_run(base: TrainConfig, arm: Arm, seed: int, forced: Options) -> Run:
    """Run of an arm: the recipe `base` with the options of the arm, then those that no arm sets.

    Raises DesignError for values that cannot be used.
    """
    options = {**arm.options, **forced, "run.seed": seed}
    try:
        config = from_dict(_with_options(to_dict(base), options))
    except ValueError as error:  # the sections have errors of their own
        raise DesignError(f"arm {arm.name}: {one_line(error)}") from error
    return Run(arm=arm, seed=seed, options=options, config=config)


def with_seeds(run: Run, seeds: Iterable[int]) -> list[Run]:
    """Return the same run with each of these seeds; options of the arm are checked once. Raises DesignError for a seed
    that cannot be used."""
    config = run.config
    try:
        return [
            dataclasses.replace(
                run,
                seed=seed,
                options={**run.options, "run.seed": seed},
                config=dataclasses.replace(config, run=dataclasses.replace(config.run, seed=seed)),
            )
            for seed in seeds
        ]
    except ConfigError as error:
        raise DesignError(f"arm {run.arm.name}: {one_line(error)}") from error


def _with_options(data: dict[str, Any], options: Options) -> dict[str, Any]:
    for name, value in options.items():
        *sections, field = name.split(".")
        section = data
        for part in sections:
            section = section[part]
        section[field] = value
    return data


def train_arguments(run: Run, recipe_name: str, folder: Path) -> list[str]:
    """Options of `kinetix-dist train` for a run, without --run. Phases are written into a file in `folder` that the
    option names."""
    words = ["--recipe", recipe_name]
    for name, value in run.options.items():
        if name == PHASES:
            file = folder / f"{run.name}.{name}.json"
            replace_file(file, json_text(value).encode())
            value = file
        words += [f"--{name}", *_words_of(value)]
    return words


def _words_of(value: Any) -> list[str]:
    """Words of an option: those of a list, nested ones too, one after another."""
    return [word for entry in value for word in _words_of(entry)] if isinstance(value, list) else [str(value)]


def hash_of(design: Design, runs: list[Run]) -> str:
    """16 hexadecimal digits over everything that results depend on. start_seconds is for the plan alone."""
    content = to_dict(dataclasses.replace(design, start_seconds=0.0))
    known: list[Any] = [content, {run.name: run.config.hash for run in runs}]
    if digests := digests_of(design.objective.sets):
        known.append(digests)
    return short_hash(known)


def short_hash(content: Any) -> str:
    """16 hexadecimal digits over plain values."""
    return hashlib.sha256(json_text(content, sort_keys=True).encode()).hexdigest()[:16]


def digests_of(level_sets: Iterable[str]) -> dict[str, str]:
    """Digest of the level files of each set that has any; those that are drawn have none."""
    return {name: digest for name in level_sets if (digest := _digest_of_files(name)) is not None}


def _digest_of_files(level_set: str) -> str | None:
    """Digest of the level files of a set; None for one that is drawn."""
    if size_of_drawn_set(level_set):
        return None
    digest = hashlib.sha256()
    for file in files_of_set(level_set):
        digest.update(file.name.encode() + hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()
