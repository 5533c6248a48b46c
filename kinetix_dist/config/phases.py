"""Section `phases` of a run's configuration: from an environment step on, other settings (docs/training.md, "Phases").

A phase begins with the first update that begins at or after its `start` and with new levels (`rollout.reset_every`).
Which one that is follows from the configuration alone, and so does everything in it: a checkpoint holds nothing of
phases, and a run that is resumed, on either side of a change, does what the unbroken one does. Settings that a phase
does not name stay as they were before.

    update    0 ... a-1     a ... b-1     b ...
    config    the run's     phase 1       phase 2          Schedule.at(update).config
"""

from __future__ import annotations

import bisect
import dataclasses
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from kinetix_dist.renamed_settings import RenamedSettingError, refuse_old_options
from kinetix_dist.text_files import read_json, read_toml

# Field of `PhaseConfig` -> setting that it changes.
CHANGES = {
    "num_envs": "rollout.num_envs",
    "minibatches": "ppo.minibatches",
    "epochs": "ppo.epochs",
    "learning_rate": "ppo.learning_rate",
    "clip": "ppo.clip",
    "entropy_coefficient": "ppo.entropy_coefficient",
    "reward": "env.reward",
    "dense_reward_scale": "env.dense_reward_scale",
    "failure_penalty": "env.failure_penalty",
    "sizes": "curriculum.sizes",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseConfig:
    """Settings from a step on. None: as before."""

    start: int  # environment steps, as in progress/env_steps
    num_envs: int | None = None
    minibatches: int | None = None
    epochs: int | None = None
    learning_rate: float | None = None
    clip: float | None = None
    entropy_coefficient: float | None = None
    reward: str | None = None
    dense_reward_scale: float | None = None
    failure_penalty: float | None = None
    sizes: tuple[tuple[str, float], ...] | None = None

    @property
    def changed(self) -> dict[str, Any]:
        """Its settings by their dotted names in a `TrainConfig`."""
        values = {path: getattr(self, name) for name, path in CHANGES.items()}
        return {path: value for path, value in values.items() if value is not None}


class _Rollout(Protocol):
    @property
    def steps_per_update(self) -> int: ...

    @property
    def reset_every(self) -> int: ...


class PhasedConfig(Protocol):
    """Part of a `TrainConfig` that phases need; a dataclass."""

    @property
    def phases(self) -> tuple[PhaseConfig, ...]: ...

    @property
    def rollout(self) -> _Rollout: ...

    def check_batch(self) -> None: ...


Config = TypeVar("Config", bound=PhasedConfig)


@dataclasses.dataclass(frozen=True)
class Phase(Generic[Config]):
    """A stretch of a run with one configuration."""

    number: int  # 0: before the first of `TrainConfig.phases`
    first_update: int
    env_steps: int  # played before it
    config: Config  # with everything that has changed until then, and without phases
    changed: dict[str, Any]  # by this phase, see `PhaseConfig.changed`

    def env_steps_after(self, num_updates: int) -> int:
        """Environment steps after so many updates of the run, `first_update` or more."""
        return self.env_steps + (num_updates - self.first_update) * self.config.rollout.steps_per_update


class Schedule(Generic[Config]):
    """The phases of a run, in order; one that lasts for ever where there are none."""

    def __init__(self, config: Config) -> None:
        """Raises ValueError for phases that do not rise, that change nothing, or whose settings cannot run."""
        self.phases = [Phase(0, first_update=0, env_steps=0, config=dataclasses.replace(config, phases=()), changed={})]
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
        if unknown := sorted(set(phase) - {"start", *CHANGES}):
            raise ValueError(
                f"{path}: phase {number} sets {unknown[0]!r}, which no phase can change; it has start and can set "
                f"{', '.join(CHANGES)}"
            )
        if "start" not in phase:
            raise ValueError(f"{path}: phase {number} has no start; say at how many environment steps it begins")
        if isinstance(phase.get("sizes"), dict):
            phase["sizes"] = [list(pair) for pair in phase["sizes"].items()]
    return content


def _following(
    before: Phase[Config], number: int, phase: PhaseConfig, phases: tuple[PhaseConfig, ...]
) -> Phase[Config]:
    name = f"phase {number}"
    previous = phases[number - 2].start if number > 1 else 0
    if phase.start <= previous:
        what = f"phase {number - 1} at {previous}" if number > 1 else "the run at 0"
        raise ValueError(f"{name} starts at {phase.start} environment steps, {what}; starts have to rise")
    if not phase.changed:
        raise ValueError(f"{name} changes nothing; set one of {', '.join(CHANGES)}, or leave the phase out")
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
        config = _changed(before.config, phase.changed)
        config.check_batch()
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    return Phase(number, first_update, before.env_steps_after(first_update), config, phase.changed)


def _changed(config: Any, changes: dict[str, Any]) -> Any:
    """A config with some fields of its sections replaced: {"ppo.clip": 0.1}."""
    sections: dict[str, dict[str, Any]] = {}
    for path, value in changes.items():
        section, field = path.split(".")
        sections.setdefault(section, {})[field] = value
    replaced = {name: dataclasses.replace(getattr(config, name), **fields) for name, fields in sections.items()}
    return dataclasses.replace(config, **replaced)
