"""The design file of a sweep, TOML: which arms are trained, for how long, and by what they are judged.

    name = "screening"              results go to runs/screening
    recipe = "pretrain_m"           what all arms have in common, with [options] of `kinetix-dist train`
    seconds = 540                   of training an arm, after its warm-up
    seeds = [1]                     every arm is trained with each
    [objective]                     weights of level sets; from which second on, every how many seconds
    [factorial] | [[arms]]          two levels of every factor | a list; of a list, [halving] trains the best for longer

docs/sweeps.md describes every field.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kinetix_dist.config import ConfigError, build, check_finite
from kinetix_dist.errors import one_line
from kinetix_dist.near_names import first_shared
from kinetix_dist.number_ranges import MAX_SEEDS
from kinetix_dist.text_files import read_toml

FORMAT = 1
MIN_FACTORS = 2
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")  # of files

Options = Mapping[str, Any]  # by full names of fields, {"ppo.epochs": 2}


class DesignError(ValueError):
    """A design that cannot be run: the field and the value, in one line."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Factor:
    """Something with two levels."""

    name: str
    low: dict[str, Any]  # options of level -
    high: dict[str, Any]  # options of level +
    generator: tuple[str, ...] = ()  # basic factors whose product of signs is its level; (): a basic factor

    def __post_init__(self) -> None:
        check_option_names(self.low, f"low of factor {self.name}")
        check_option_names(self.high, f"high of factor {self.name}")
        if self.low.keys() != self.high.keys() or not self.low:
            raise DesignError(
                f"factor {self.name} sets {_names(self.low)} at low and {_names(self.high)} at high; set the same"
            )
        if self.low == self.high:
            raise DesignError(f"factor {self.name} has the same values at low and high; change one")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Factorial:
    """A two-level design: full where no factor has a generator, else a fraction of it."""

    factors: tuple[Factor, ...]
    fold_over: bool = False  # as many arms more, with all levels changed
    fold_over_seeds: tuple[int, ...] = ()  # of these; (): the seeds of the others

    def __post_init__(self) -> None:
        if len(self.factors) < MIN_FACTORS:
            raise DesignError(f"factorial has {len(self.factors)} factors; give {MIN_FACTORS} or more, or arms")
        check_names([factor.name for factor in self.factors], "factor")
        if self.fold_over_seeds and not self.fold_over:
            raise DesignError("factorial has fold_over_seeds but no fold_over; set fold_over = true, or leave them out")
        basic = {factor.name for factor in self.factors if not factor.generator}
        for factor in self.factors:
            if wrong := sorted(set(factor.generator) - basic):
                raise DesignError(
                    f"factor {factor.name} has generator {wrong[0]!r}, which is no basic factor; these are "
                    f"{', '.join(sorted(basic))}"
                )
            if factor.generator and len(set(factor.generator)) < max(len(factor.generator), 2):
                raise DesignError(f"factor {factor.name} needs a generator of two different factors or more")
        owners: dict[str, str] = {}
        for factor in self.factors:
            for option in factor.low:
                if option in owners:
                    raise DesignError(f"factors {owners[option]} and {factor.name} both set {option}; let one do it")
                owners[option] = factor.name


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmOptions:
    """One arm of a list."""

    name: str
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # besides those of the design

    def __post_init__(self) -> None:
        check_option_names(self.options, f"options of arm {self.name}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rung:
    """Seconds of training before arms are compared, and the share that goes on."""

    seconds: float  # of training since the start
    keep: float = 0.0  # share of the arms that goes on; of the last rung none


@dataclasses.dataclass(frozen=True, kw_only=True)
class Halving:
    """Successive halving: arms that do best go on from their checkpoints."""

    rungs: tuple[Rung, ...]

    def __post_init__(self) -> None:
        if len(self.rungs) < 2:
            raise DesignError(f"halving has {len(self.rungs)} rungs; give 2 or more")
        seconds = [rung.seconds for rung in self.rungs]
        if sorted(set(seconds)) != seconds or seconds[0] <= 0:
            raise DesignError(f"seconds of rungs are {_listed(seconds)}; each has to be above 0 and the one before")
        for rung in self.rungs[:-1]:
            if not 0 < rung.keep < 1:
                raise DesignError(
                    f"the rung of {rung.seconds:g} s has keep {rung.keep:g}; give a share below 1, above 0"
                )
        if self.rungs[-1].keep:
            raise DesignError(f"the last rung has keep {self.rungs[-1].keep:g}; none goes on from there: leave it out")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Objective:
    """Quantity to maximise: the area under the curve of weighted solve rates over seconds of training, divided by its
    span. It lies between 0 and 1."""

    sets: dict[str, float]  # weight of each level set
    every_seconds: float  # between evaluations
    from_second: float = 0.0  # where the area begins

    def __post_init__(self) -> None:
        if not isinstance(self.sets, Mapping) or not self.sets:
            raise DesignError("objective.sets is empty; give a weight to one level set or more")
        for name, weight in self.sets.items():
            if not _is_number(weight) or weight < 0:
                raise DesignError(f"objective.sets gives {name} the weight {weight!r}; a number of 0 or more is needed")
        if not sum(self.sets.values()) > 0:
            raise DesignError("all weights of objective.sets are 0; give one that is above")
        if not self.every_seconds > 0 or not math.isfinite(self.every_seconds):
            raise DesignError(f"objective.every_seconds is {self.every_seconds:g}; it must be above 0")
        if self.from_second < 0:
            raise DesignError(f"objective.from_second is {self.from_second:g}; it must be 0 or more")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Design:
    """A sweep."""

    name: str
    recipe: str
    objective: Objective
    format: int = FORMAT
    seconds: float = 0.0  # of training an arm, after its warm-up; with halving its rungs say it
    seeds: tuple[int, ...] = (0,)
    start_seconds: float = 60.0  # of an arm besides: start, warm-up, first evaluations, end; for the plan alone
    options: dict[str, Any] = dataclasses.field(default_factory=dict)  # of all arms
    factorial: Factorial | None = None
    arms: tuple[ArmOptions, ...] = ()
    halving: Halving | None = None

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise DesignError(f"format is {self.format}; this version reads format {FORMAT}")
        check_finite(self)
        check_names([self.name], "design")
        check_option_names(self.options, "options")
        if (self.factorial is None) == (not self.arms):
            raise DesignError("give either factorial or arms")
        check_names([arm.name for arm in self.arms], "arm")
        if self.halving is not None and not self.arms:
            raise DesignError("halving compares the arms of a list; give arms, not factorial")
        if self.halving is not None and self.seconds:
            raise DesignError("with halving its rungs say the seconds; leave out seconds")
        if self.start_seconds < 0:
            raise DesignError(f"start_seconds is {self.start_seconds:g}; it must be 0 or more")
        for what, seeds in (("seeds", self.seeds), ("fold_over_seeds", self.fold_over_seeds)):
            if len(seeds) > MAX_SEEDS:
                raise DesignError(f"{what} are {len(seeds):,} numbers; give {MAX_SEEDS:,} or fewer")
            if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
                raise DesignError(f"{what} are {_listed(seeds)}; give different numbers of 0 or more")
        every = self.objective.every_seconds
        for seconds in self.rung_seconds:
            if seconds <= self.objective.from_second:
                raise DesignError(
                    f"arms train for {seconds:g} s, but the objective begins at second {self.objective.from_second:g}; "
                    "raise the one or lower the other"
                )
            if not math.isclose(seconds / every, round(seconds / every), abs_tol=1e-6):
                raise DesignError(
                    f"arms train for {seconds:g} s, which is no multiple of objective.every_seconds {every:g}: "
                    "there would be no evaluation at the end; change one"
                )

    @property
    def rung_seconds(self) -> tuple[float, ...]:
        """Seconds after which arms are compared; one number without halving."""
        return (self.seconds,) if self.halving is None else tuple(rung.seconds for rung in self.halving.rungs)

    @property
    def fold_over_seeds(self) -> tuple[int, ...]:
        return (self.factorial.fold_over_seeds if self.factorial is not None else ()) or self.seeds


def read_design(path: Path) -> Design:
    """Raises DesignError for a file that is no design, one line that names it."""
    try:
        data = read_toml(path)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else one_line(error)
        raise DesignError(f"{path} cannot be read as a design ({reason})") from error
    try:
        return build(Design, data)
    except (ConfigError, DesignError) as error:
        raise DesignError(f"{path}: {one_line(error)}") from error


def check_names(names: Sequence[str], what: str) -> None:
    """Raise DesignError for names that are no file names, or of which two would share a directory."""
    for name in names:
        if not NAME.fullmatch(name):
            raise DesignError(f"{what} name {name!r} is none; use letters, digits, _, - and .")
    if shared := first_shared(names):
        first, second = shared
        other = "" if first == second else f" or {second!r}, which share a directory on some file systems"
        raise DesignError(f"two of them have the {what} name {first!r}{other}; change one")


def check_option_names(options: Any, what: str) -> None:
    """Raises DesignError for options that are no table, or have tables in them."""
    if not isinstance(options, Mapping):
        raise DesignError(f"{what} is {options!r}; a table of options is needed")
    for name, value in options.items():
        if isinstance(value, Mapping):
            raise DesignError(f'{what} has {name} as a table; write full names in quotes, as in "ppo.epochs" = 2')


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _names(options: Options) -> str:
    return ", ".join(options) or "nothing"


def _listed(numbers: Sequence[float]) -> str:
    return ", ".join(f"{number:g}" for number in numbers) or "none"
