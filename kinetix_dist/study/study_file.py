"""The file of a study, TOML: a question, the arms that answer it, and where they are evaluated.

    name = "filter"                 results go to runs/studies/filter
    question, paper, finding        in a sentence each; finding: what ours shows
    recipe = "pretrain_m"           what all arms have in common, with [options] of `kinetix-dist train`
    env_steps, every_steps          environment steps of a run, and between its evaluations
    sets = ["random_m"]             level sets of these evaluations
    [[arms]]                        name and options of each, and env_steps and sets where they are its own; `reference`
                                    is the one that others are compared with
    [cost]                          speed by which minutes are predicted
    [figure]                        what is drawn
    [small]                         the same in seconds on a CPU, by `--small`

docs/studies.md describes every field.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from kinetix_dist.setting import check_settings, setting
from kinetix_dist.study.choice import check_arms
from kinetix_dist.sweep.arms import PHASES
from kinetix_dist.sweep.design import ArmOptions, DesignError, check_names, check_option_names

FORMAT = 1
NOT_RUN = "not run yet"
CURVES, LEVELS, LEARNABILITY, FORGETTING = FIGURES = ("curves", "levels", "learnability", "forgetting")
SMALL = "_small"  # after the name of a study in its small version


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cost:
    """Speed of a run, for predictions before any run of the arm was trained here."""

    steps_per_second: float = setting(1.0, above=0)  # environment steps
    start_seconds: float = setting(60.0, minimum=0)  # of a run besides: start, compilation, evaluations, end
    device: str = "one GPU"  # on which that is so

    def __post_init__(self) -> None:
        check_settings(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Figure:
    """Picture of the results."""

    # Curves, a panel a set. Besides: "levels", each level's rate, a panel an arm; "learnability", of what was chosen;
    # "forgetting", rates after each phase, a matrix an arm.
    kind: str = setting(CURVES, choices=FIGURES)
    sets: tuple[str, ...] = ()  # panels, in this order; (): all sets
    tasks: tuple[str, ...] = ()  # of "forgetting": the set that each phase of an arm trains for, in order

    def __post_init__(self) -> None:
        check_settings(self)
        if bool(self.tasks) != (self.kind == FORGETTING):
            raise DesignError(
                f"figure.kind is {self.kind!r} and figure.tasks {', '.join(self.tasks) or 'none'}; tasks, the set that "
                f"each phase trains for, belong to {FORGETTING!r}, and to no other"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class StudyArm(ArmOptions):
    """One arm. It may be trained for longer or shorter than the others, and evaluated on some of the sets."""

    env_steps: int | None = None  # of each run; None: those of the study
    sets: tuple[str, ...] = ()  # level sets of its evaluations, of the study's; (): all of them


@dataclasses.dataclass(frozen=True, kw_only=True)
class Small:
    """Differences of the version that runs in seconds on a CPU. It shows that a study works, nothing else.

    An arm with `env_steps` of its own has the same share of the study's; one with `sets` has those that are left."""

    recipe: str
    env_steps: int
    every_steps: int
    sets: tuple[str, ...]
    cost: Cost
    attempts: int = 1
    seeds: int = 1
    arms: tuple[str, ...] = ()  # of the study; (): all
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # in place of the study's; over those of arms
    phases: tuple[dict[str, Any], ...] = ()  # of arms that have any, in place of theirs
    tasks: tuple[str, ...] = ()  # in place of figure.tasks

    def __post_init__(self) -> None:
        check_option_names(self.options, "small.options")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study:
    """A study."""

    name: str
    question: str
    paper: str  # what the paper shows, in a sentence
    recipe: str
    env_steps: int  # of each run
    every_steps: int  # between evaluations
    sets: tuple[str, ...]  # level sets of the evaluations
    reference: str  # arm that the others are compared with
    arms: tuple[StudyArm, ...]
    cost: Cost
    format: int = FORMAT
    finding: str = NOT_RUN  # what ours shows, in a sentence
    attempts: int = setting(1, minimum=1)  # at each level in an evaluation
    seeds: int = setting(3, minimum=1)  # every arm is trained with so many, the first one and those after it
    first_seed: int = setting(1, minimum=0)
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # of all arms
    figure: Figure = dataclasses.field(default_factory=Figure)
    small: Small | None = None

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise DesignError(f"format is {self.format}; this version reads format {FORMAT}")
        check_settings(self)
        check_names([self.name], "study")
        check_names([arm.name for arm in self.arms], "arm")
        check_option_names(self.options, "options")
        if len(self.arms) < 1:
            raise DesignError("a study has no arms; give one or more")
        arm_names = [arm.name for arm in self.arms]
        check_arms([self.reference], arm_names, "reference {name} is no arm")
        if not self.sets or len(set(self.sets)) < len(self.sets):
            raise DesignError(f"sets are {', '.join(self.sets) or 'none'}; name one level set or more, each once")
        for field in ("sets", "tasks"):
            if missing := [name for name in getattr(self.figure, field) if name not in self.sets]:
                raise DesignError(f"figure.{field} has {missing[0]}, which is not one of the sets; add it to them")
        self._check_length("", self.env_steps)
        for arm in self.arms:
            self._check_length(f" of arm {arm.name}", self.env_steps_of(arm.name))
            if missing := [name for name in arm.sets if name not in self.sets]:
                raise DesignError(f"arm {arm.name} has set {missing[0]}, which is not one of the sets; add it to them")
            if missing := [name for name in self.figure.tasks if name not in self.sets_of(arm.name)]:
                raise DesignError(f"arm {arm.name} is not evaluated on {missing[0]}, a task; add it to its sets")
        if self.small is not None:
            _ = self.as_small  # raises where it is none

    def _check_length(self, whose: str, env_steps: int) -> None:
        if not 0 < self.every_steps <= env_steps or env_steps % self.every_steps:
            raise DesignError(
                f"env_steps{whose} is {env_steps} and every_steps {self.every_steps}; give a multiple, so that there "
                "is an evaluation at the end"
            )

    def env_steps_of(self, arm: str) -> int:
        """Environment steps of each run of an arm."""
        own = self._arm(arm).env_steps
        return self.env_steps if own is None else own

    def num_points_of(self, arm: str) -> int:
        """Evaluations of a run of an arm, without the one before training."""
        return self.env_steps_of(arm) // self.every_steps

    @property
    def num_points(self) -> int:
        """Evaluations of a run of the longest arm, without the one before training."""
        return max(self.num_points_of(arm.name) for arm in self.arms)

    @property
    def has_one_length(self) -> bool:
        """All arms are trained for the same steps."""
        return len({self.env_steps_of(arm.name) for arm in self.arms}) == 1

    def sets_of(self, arm: str) -> tuple[str, ...]:
        """Level sets on which an arm is evaluated, in the order of the study."""
        own = self._arm(arm).sets
        return tuple(name for name in self.sets if not own or name in own)

    def _arm(self, name: str) -> StudyArm:
        return next(arm for arm in self.arms if arm.name == name)

    @property
    def panels(self) -> tuple[str, ...]:
        """Level sets of the figure."""
        return self.figure.sets or self.sets

    @property
    def as_small(self) -> Study:
        """The small version. Raises DesignError where there is none."""
        small = self.small
        if small is None:
            raise DesignError(f"study {self.name} has no small version; add a section [small], or leave out --small")
        check_arms(small.arms, [arm.name for arm in self.arms], "small.arms has {name}")
        phases = {PHASES: list(small.phases)}
        arms = [
            dataclasses.replace(
                arm,
                options={**arm.options, **small.options, **(phases if PHASES in arm.options else {})},
                env_steps=None if arm.env_steps is None else arm.env_steps * small.env_steps // self.env_steps,
                sets=tuple(name for name in arm.sets if name in small.sets),
            )
            for arm in self.arms
            if not small.arms or arm.name in small.arms
        ]
        if without := [arm.name for arm in arms if self._arm(arm.name).sets and not arm.sets]:
            raise DesignError(f"small.sets has none of the sets of arm {without[0]}; add one, or leave it out of arms")
        try:
            return dataclasses.replace(
                self,
                name=f"{self.name}{SMALL}",
                finding=NOT_RUN,
                recipe=small.recipe,
                env_steps=small.env_steps,
                every_steps=small.every_steps,
                sets=small.sets,
                attempts=small.attempts,
                seeds=small.seeds,
                cost=small.cost,
                options={},
                arms=tuple(arms),
                figure=dataclasses.replace(self.figure, sets=(), tasks=small.tasks),
                small=None,
            )
        except ValueError as error:
            raise DesignError(f"small: {error}") from error
