"""Options of the benchmarks of training: a recipe, made so short that only its speed can be seen."""

from __future__ import annotations

import dataclasses
import json
import statistics
from typing import Any, Literal

from kinetix_dist.benchmarks.measuring import BenchmarkOptions
from kinetix_dist.config import EvaluationConfig, RecordingConfig, TrainConfig, from_dict, to_dict
from kinetix_dist.recipes import recipe
from kinetix_dist.renamed_settings import refuse_old_options

# A measured run evaluates nothing. A configuration names a set, and a GPU has memory reserved for it: the smallest.
EVALUATION = EvaluationConfig(sets=("s/hop_home",), attempts=1, min_attempts=0)
NUM_WARM_UPDATES = 2  # of a run, not measured: the first compiles, the second may load its programs
SHARE = "time/"  # of a metric: the fraction of an update that a role took


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainingOptions(BenchmarkOptions):
    """Options of every benchmark of training."""

    recipe: str = "quickstart"
    """The recipe to measure (docs/training.md lists them)."""
    set: tuple[str, ...] = ()
    """Fields of its configuration, such as rollout.num_envs=1024 ppo.epochs=1."""
    device: Literal["auto", "cpu", "gpu"] | None = None
    """Device that it runs on. Default: as the recipe says."""

    def __post_init__(self) -> None:
        self.config()

    def config(self) -> TrainConfig:
        """The recipe with `set` and `device`; raises ConfigError for a field or a value that cannot be."""
        config = with_fields(recipe(self.recipe), self.set)
        if self.device is not None:
            config = dataclasses.replace(config, run=dataclasses.replace(config.run, device=self.device))
        return config


def with_fields(config: TrainConfig, assignments: tuple[str, ...]) -> TrainConfig:
    """Return `config` with each "section.field=value" applied; a value is JSON, or else a string."""
    content = to_dict(config)
    for assignment in assignments:
        name, is_assigned, text = assignment.partition("=")
        refuse_old_options({name: text})
        *sections, field = name.split(".")
        part: Any = content
        for section in sections:
            part = part.get(section) if isinstance(part, dict) else None
        if not is_assigned or not isinstance(part, dict) or field not in part:
            raise ValueError(f"--set has {assignment!r}; give a field of the configuration, such as ppo.epochs=1")
        try:
            part[field] = json.loads(text)
        except json.JSONDecodeError:
            part[field] = text
    return from_dict(content)


def shortened(config: TrainConfig, num_updates: int) -> TrainConfig:
    """Return `config` for `num_updates` updates and nothing else: no evaluation, recording, picture or checkpoint."""
    run = dataclasses.replace(
        config.run,
        total_env_steps=num_updates * config.rollout.steps_per_update,
        max_seconds=0.0,
        stop_at=0.0,
        only_updates=True,
    )
    return dataclasses.replace(config, run=run, evaluation=EVALUATION, recording=RecordingConfig(num_rollouts=0))


def speeds(rows: list[dict[str, Any]]) -> list[float]:
    """Environment steps/s of the measured updates, everything included."""
    return [row["progress/env_steps_per_second"] for row in measured(rows)]


def seconds_before(rows: list[dict[str, Any]]) -> float:
    """Return the seconds between the first update, which compiles, and the measured ones."""
    seconds = {row["update"]: row["progress/seconds"] for row in rows}
    return seconds[NUM_WARM_UPDATES] - seconds[1]


def measured(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the updates that count."""
    return [row for row in rows if row["update"] > NUM_WARM_UPDATES]


def shares_of_time(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return the fraction of the measured time by role; they add up to 1."""
    weights = [1.0 / speed for speed in speeds(rows)]  # updates have the same number of steps
    return {
        name.removeprefix(SHARE): round(statistics.fmean((row[name] for row in measured(rows)), weights), 4)
        for name in rows[0]
        if name.startswith(SHARE)
    }
