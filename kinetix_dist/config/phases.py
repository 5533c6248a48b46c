"""Section `phases` of a run's configuration: from an environment step on, other settings (docs/training.md, "Phases").

A phase begins with the first update that begins at or after its `start` and with new levels (`rollout.reset_every`).
Which one that is follows from the configuration alone, and so does everything in it: a checkpoint holds nothing of
phases, and a run that is resumed, on either side of a change, does what the unbroken one does. Settings that a phase
does not name stay as they were before.

    update    0 ... a-1     a ... b-1     b ...
    config    the run's     phase 1       phase 2          Schedule.at(update).config

A phase can change every setting with which the parameters, the optimiser's state and the processes go on (`FIXED` says
which these are not). The state of the curriculum begins afresh with a phase that changes what it consists of:
`Phase.curriculum_since`.
"""

from __future__ import annotations

import bisect
import dataclasses
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, TypeVar, get_type_hints

from kinetix_dist.config.plain import build, flat, to_dict
from kinetix_dist.near_names import did_you_mean
from kinetix_dist.renamed_settings import PHASE_NAMES, RenamedSettingError, refuse_old_options
from kinetix_dist.text_files import read_json, read_toml

_SHAPES = "the parameters have their shapes by it"
_DIVISION = "worlds are divided over processes by it"
_WHOLE_RUN = "it is of the run as a whole"
# Setting or section that no phase changes -> why.
FIXED = {
    "policy": _SHAPES,
    "env.observation": _SHAPES,
    "env.action_space": _SHAPES,
    "ppo.average_updates": "the learner's state has its parts by it",
    "ppo.virtual_shards": _DIVISION,
    "rollout.num_groups": _DIVISION,
    "rollout.reset_every": "resets are counted from the start of the run",
    "evaluation": _WHOLE_RUN,
    "recording": _WHOLE_RUN,
    "curriculum_log": _WHOLE_RUN,
    "plasticity": _WHOLE_RUN,
    "run": _WHOLE_RUN,
}
UNCHANGED: dict[str, Any] = dict.fromkeys(PHASE_NAMES)  # a phase of before they had options that changes nothing
SIZES = "curriculum.sizes"
# Fields of `curriculum` that say which levels are drawn: its state goes on when they change.
DRAWN = ("sizes", "filter_noop", "generator")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseConfig:
    """Settings from a step on."""

    start: int  # environment steps, as in progress/env_steps
    options: dict[str, Any] = dataclasses.field(default_factory=dict, hash=False)  # by full names, {"ppo.clip": 0.1}


class _Rollout(Protocol):
    @property
    def steps_per_update(self) -> int: ...

    @property
    def reset_every(self) -> int: ...


class PhasedConfig(Protocol):
    """Part of a `TrainConfig` that phases need; a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

    @property
    def phases(self) -> tuple[PhaseConfig, ...]: ...

    @property
    def rollout(self) -> _Rollout: ...

    def check_batch(self) -> None: ...

    def check_follows(self, before: Any, changed: Collection[str]) -> None: ...


Config = TypeVar("Config", bound=PhasedConfig)


@dataclasses.dataclass(frozen=True)
class Phase(Generic[Config]):
    """A stretch of a run with one configuration."""

    number: int  # 0: before the first of `TrainConfig.phases`
    first_update: int
    env_steps: int  # played before it
    config: Config  # with everything that has changed until then, and without phases
    changed: dict[str, Any]  # by this phase, by full names
    curriculum_since: int  # update with which the curriculum's state began

    def env_steps_after(self, num_updates: int) -> int:
        """Environment steps after so many updates of the run, `first_update` or more."""
        return self.env_steps + (num_updates - self.first_update) * self.config.rollout.steps_per_update


class Schedule(Generic[Config]):
    """The phases of a run, in order; one that lasts for ever where there are none."""

    def __init__(self, config: Config) -> None:
        """Raises ValueError for phases that do not rise, that change nothing or what is fixed, or whose settings cannot
        run."""
        first = dataclasses.replace(config, phases=())
        self.phases = [Phase(0, first_update=0, env_steps=0, config=first, changed={}, curriculum_since=0)]
        for number, phase in enumerate(config.phases, start=1):
            self.phases.append(_following(self.phases[-1], number, phase, config.phases))
        self._first_updates = [phase.first_update for phase in self.phases]

    def at(self, update: int) -> Phase[Config]:
        """The phase of an update (0 is the first one), and of the batch that it learns from."""
        return self.phases[bisect.bisect_right(self._first_updates, update) - 1]

    def beginning(self, update: int) -> Phase[Config] | None:
        """The phase whose first update this is, if there is one; what a run starts with begins nothing."""
        phase = self.at(update)
        return phase if phase.number and update == phase.first_update else None

    def env_steps(self, num_updates: int) -> int:
        """Environment steps in so many updates."""
        return self.at(num_updates).env_steps_after(num_updates)


def read_phases(path: Path) -> list[dict[str, Any]]:
    """The phases in a file, as plain values: TOML with a table `[[phases]]` for each, or JSON, {"phases": [...]} or the
    list alone. Raises ValueError or OSError, one line each."""
    try:
        content: Any = read_json(path) if path.suffix == ".json" else read_toml(path)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read as {'JSON' if path.suffix == '.json' else 'TOML'}: {error}") from error
    if isinstance(content, dict) and set(content) == {"phases"}:
        content = content["phases"]
    if not isinstance(content, list) or not all(isinstance(phase, dict) for phase in content):
        raise ValueError(f'{path} holds no phases; write a table [[phases]] for each, in JSON {{"phases": [...]}}')
    for number, phase in enumerate(content, start=1):
        try:
            refuse_old_options({"phases": [phase]})
        except RenamedSettingError as error:
            raise ValueError(f"{path}: phase {number}: {error}") from None
        if unknown := sorted(set(phase) - {"start", "options"}):
            raise ValueError(
                f"{path}: phase {number} has {unknown[0]!r}; it has start, and options = {{}} with settings by full "
                'names in quotes, such as "ppo.clip" = 0.1'
            )
        if "start" not in phase:
            raise ValueError(f"{path}: phase {number} has no start; say at how many environment steps it begins")
        options = phase.get("options", {})
        if isinstance(options, dict) and isinstance(options.get(SIZES), dict):
            options[SIZES] = [list(pair) for pair in options[SIZES].items()]
    return content


def numbers_of_phases(schedule: Schedule[Any], phases: tuple[PhaseConfig, ...]) -> list[dict[str, Any]]:
    """Plain values of phases, in the words from before they could change any setting: `UNCHANGED` and what differs."""
    names = {option: name for name, option in PHASE_NAMES.items()}
    return [
        {"start": config.start, **UNCHANGED}
        | {names.get(option, option): value for option, value in phase.changed.items()}
        for config, phase in zip(phases, schedule.phases[1:], strict=True)
    ]


def _following(
    before: Phase[Config], number: int, phase: PhaseConfig, phases: tuple[PhaseConfig, ...]
) -> Phase[Config]:
    name = f"phase {number}"
    previous = phases[number - 2].start if number > 1 else 0
    if phase.start <= previous:
        what = f"phase {number - 1} at {previous}" if number > 1 else "the run at 0"
        raise ValueError(f"{name} starts at {phase.start} environment steps, {what}; starts have to rise")
    if not phase.options:
        raise ValueError(f'{name} changes nothing; name settings in its options, such as "ppo.clip", or leave it out')
    rollout = before.config.rollout
    num_resets = -(-(phase.start - before.env_steps) // (rollout.reset_every * rollout.steps_per_update))
    num_updates = num_resets * rollout.reset_every
    if num_updates < 1:
        raise ValueError(
            f"{name} starts at {phase.start} environment steps, within the first update of phase {number - 1} "
            f"(until {before.env_steps_after(before.first_update + rollout.reset_every)}), which would have none; "
            "start it later"
        )
    first_update = before.first_update + num_updates
    try:
        config = with_options(before.config, phase.options)
        config.check_batch()
        config.check_follows(before.config, phase.options)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    return Phase(
        number,
        first_update,
        before.env_steps_after(first_update),
        config,
        changed={option: value_of(config, option) for option in phase.options},
        curriculum_since=before.curriculum_since if _keeps_curriculum(before.config, config) else first_update,
    )


def _keeps_curriculum(before: Any, config: Any) -> bool:
    """The state of the curriculum goes on: levels are of one size, and its settings but for `DRAWN` are the same."""
    drawn = {name: getattr(before.curriculum, name) for name in DRAWN}
    return before.env.size == config.env.size and before.curriculum == _replaced(config.curriculum, drawn)


def with_options(config: Config, options: Mapping[str, Any]) -> Config:
    """A config with other settings, by full names and as plain values. Raises ValueError for those that are unknown, of
    another type, or fixed."""
    known = flat(to_dict(config))
    for option, value in options.items():
        parts = option.split(".")
        prefixes = [".".join(parts[:length]) for length in range(1, len(parts) + 1)]
        if why := next((FIXED[prefix] for prefix in prefixes if prefix in FIXED), None):
            raise ValueError(f"{option} cannot change within a run: {why}; leave it out of the phase")
        if option not in known:
            if any(name.startswith(f"{option}.") for name in known):
                hint = f'it is a section: name its settings, "{option}.NAME" = VALUE with the quotes'
            else:
                hint = did_you_mean(option, known, "`kinetix-dist train --help-all` lists all")
            raise ValueError(f"unknown setting {option!r}; {hint}")
        refuse_old_options({option: value})
    return _replaced(config, options)


def _replaced(config: Any, options: Mapping[str, Any]) -> Any:
    """A config, or a section of one, with fields by dotted names replaced: {"ppo.clip": 0.1}."""
    hints = get_type_hints(type(config))
    sections: dict[str, dict[str, Any]] = {}
    fields: dict[str, Any] = {}
    for option, value in options.items():
        name, _, rest = option.partition(".")
        if rest:
            sections.setdefault(name, {})[rest] = value
        else:
            fields[name] = value if dataclasses.is_dataclass(value) else build(hints[name], value, name)
    fields |= {name: _replaced(getattr(config, name), inner) for name, inner in sections.items()}
    return dataclasses.replace(config, **fields)


def value_of(config: Any, option: str) -> Any:
    """Value of a setting, or a section, by its full name."""
    for name in option.split("."):
        config = getattr(config, name)
    return config
