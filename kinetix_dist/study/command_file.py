"""The file of a study whose arms are commands of kinetix-dist, TOML: what is asked of policies or of a machine.

    name, question, paper, finding      as in `study_file.py`
    command = ["bench", "goals", "--checkpoint", "{policy}", "--seed", "{seed}", "--json", "{out}/records.json"]
    results = "goal_following"          how what it writes is read and drawn (`command_results`)
    [values]                            of the names in braces, for all arms
    [[arms]]                            name and values of each
    [cost]                              minutes of a run
    [small]                             values that make it one of seconds, by `--small`

In braces besides: `seed`; `part` and `parts`, where a run is cut into several; `out`, the directory of the run. A list
stands for as many words.
"""

from __future__ import annotations

import dataclasses
import string
from collections.abc import Mapping, Sequence
from typing import Any

from kinetix_dist.near_names import did_you_mean
from kinetix_dist.setting import check_settings, setting
from kinetix_dist.study.choice import check_arms
from kinetix_dist.study.command_results import RESULTS
from kinetix_dist.study.study_file import FORMAT, NOT_RUN, SMALL
from kinetix_dist.sweep.design import DesignError, check_names

BUILT_IN = ("seed", "part", "parts", "out")


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandArm:
    """One arm."""

    name: str
    values: dict[str, Any] = dataclasses.field(default_factory=dict)  # besides those of the study


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandCost:
    """Time of a run, for predictions."""

    minutes: float = setting(1.0, above=0)
    device: str = "one GPU"  # on which that is so

    def __post_init__(self) -> None:
        check_settings(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandSmall:
    """Differences of the version that runs in seconds on a CPU."""

    values: dict[str, Any]  # over those of the study and of arms
    cost: CommandCost
    arms: tuple[str, ...] = ()  # of the study; (): all


@dataclasses.dataclass(frozen=True, kw_only=True)
class CommandStudy:
    """A study of commands."""

    name: str
    question: str
    paper: str  # what the paper shows, in a sentence
    command: tuple[str, ...]  # words of kinetix-dist
    results: str
    arms: tuple[CommandArm, ...]
    cost: CommandCost
    format: int = FORMAT
    finding: str = NOT_RUN  # what ours shows, in a sentence
    values: dict[str, Any] = dataclasses.field(default_factory=dict)
    seeds: int = setting(1, minimum=1)  # every arm is run with so many, the first one and those after it
    first_seed: int = setting(0, minimum=0)
    parts: int = setting(1, minimum=1)  # of each arm and seed, each a run of its own
    needs_gpu: bool = False  # False: it runs on GPUs where there are any, else on CPUs
    small: CommandSmall | None = None

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise DesignError(f"format is {self.format}; this version reads format {FORMAT}")
        check_settings(self)
        check_names([self.name], "study")
        check_names([arm.name for arm in self.arms], "arm")
        if not self.arms:
            raise DesignError("a study has no arms; give one or more")
        if self.results not in RESULTS:
            hint = did_you_mean(self.results, RESULTS, f"there are {', '.join(RESULTS)}")
            raise DesignError(f"unknown results {self.results!r}; {hint}")
        for arm in self.arms:
            words_of(self.command, {**self.values, **arm.values, **dict.fromkeys(BUILT_IN, 0)})
        if self.small is not None:
            _ = self.as_small  # raises where it is none

    @property
    def as_small(self) -> CommandStudy:
        """The small version. Raises DesignError where there is none."""
        small = self.small
        if small is None:
            raise DesignError(f"study {self.name} has no small version; add a section [small], or leave out --small")
        check_arms(small.arms, [arm.name for arm in self.arms], "small.arms has {name}")
        arms = [
            dataclasses.replace(arm, values={**arm.values, **small.values})
            for arm in self.arms
            if not small.arms or arm.name in small.arms
        ]
        return dataclasses.replace(
            self,
            name=f"{self.name}{SMALL}",
            finding=NOT_RUN,
            arms=tuple(arms),
            seeds=1,
            parts=1,
            cost=small.cost,
            needs_gpu=False,
            small=None,
        )


def words_of(command: Sequence[str], values: Mapping[str, Any]) -> list[str]:
    """Words of a command with the values of the names in braces. Raises DesignError for a name without one."""
    words: list[str] = []
    for word in command:
        names = [name for _, name, _, _ in string.Formatter().parse(word) if name is not None]
        for name in names:
            if name not in values:
                hint = did_you_mean(name, values, f"there are {', '.join(values)}")
                raise DesignError(f"command has {{{name}}}, which has no value; {hint}")
        if len(names) == 1 and word == f"{{{names[0]}}}" and isinstance(values[names[0]], list | tuple):
            words += map(str, values[names[0]])
        else:
            words.append(word.format(**values))
    return words
