"""Configuration of a run: one frozen dataclass whose sections are the configs of its parts.

Its hash covers what changes the numbers (not: how long, where to, how often it is evaluated or saved). A checkpoint
carries it and is only resumed by a config of the same hash.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import operator
from collections.abc import Collection, Mapping
from typing import Any

from kinetix_dist.config import checks
from kinetix_dist.config.phases import UNCHANGED, PhaseConfig, Schedule, numbers_of_phases
from kinetix_dist.config.plain import flat, in_words, to_dict
from kinetix_dist.config.refresh_times import RefreshTimes, refresh_times
from kinetix_dist.config.sections import (
    EvaluationConfig,
    ImitationConfig,
    RecordingConfig,
    RolloutConfig,
    RunConfig,
)
from kinetix_dist.curator.config import OWN_SECTIONS, CurriculumConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.curriculum import Curriculum
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.json_text import json_text
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.plasticity import PlasticityConfig
from kinetix_dist.models.policy import PolicyConfig
from kinetix_dist.setting import check_finite
from kinetix_dist.telemetry.curriculum_log import CurriculumLogConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything a training run depends on, section by section."""

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    policy: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    ppo: PpoConfig = dataclasses.field(default_factory=PpoConfig)
    curriculum: CurriculumConfig = dataclasses.field(default_factory=CurriculumConfig)
    rollout: RolloutConfig = dataclasses.field(default_factory=RolloutConfig)
    imitation: ImitationConfig = dataclasses.field(default_factory=ImitationConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    recording: RecordingConfig = dataclasses.field(default_factory=RecordingConfig)
    curriculum_log: CurriculumLogConfig = dataclasses.field(default_factory=CurriculumLogConfig)
    plasticity: PlasticityConfig = dataclasses.field(default_factory=PlasticityConfig)
    phases: tuple[PhaseConfig, ...] = ()  # from a step on, other settings; the sections above hold until the first
    run: RunConfig

    def __post_init__(self) -> None:
        check_finite(self)
        env, rollout, curriculum, run = self.env, self.rollout, self.curriculum, self.run
        checks.check_sizes(env, curriculum)
        checks.check_action_space(env, self.policy, self.ppo)
        checks.check_network(env, self.policy)
        checks.check_reward(env, self.ppo)
        checks.check_resets(run, rollout, curriculum, self.curriculum_class)
        checks.check_episode_lengths(rollout, env, curriculum, self.curriculum_class)
        checks.check_curators(run, curriculum, self.curriculum_class)
        checks.check_rollout_actors(run, rollout)
        checks.check_stop(run, self.evaluation)
        checks.check_only_updates(run, self.evaluation, self.recording)
        checks.check_imitation(self.env, self.policy, self.curriculum, self.imitation, run)
        if self.phases:
            self.check_batch()
            _ = self.refresh_times  # raises for phases that cannot run

    @property
    def cut_episodes(self) -> str:
        """A line about episodes that are not played to their end; "": there are none."""
        rollout, max_steps = self.rollout, self.env.max_steps
        num_steps = rollout.steps_between_resets
        if num_steps >= max_steps:
            return ""
        resets = "every update begins its levels again"
        if rollout.reset_every > 1:
            resets = f"levels begin again every {rollout.reset_every} updates"
        return (
            f"rollout.num_steps is {rollout.num_steps} and env.max_steps {max_steps}: {resets}, so "
            f"that what comes after step {num_steps} of an episode is never learned from; raise the one or "
            "rollout.reset_every, or lower the other"
        )

    def check_generator(self) -> None:
        """Raises ConfigError where a size of levels fits none of the families that the generator is to draw."""
        checks.check_generator(self.env, self.curriculum)

    def check_batch(self) -> None:
        """Raises ValueError, with the numbers, where the samples of an update cannot be divided into minibatches."""
        self.ppo.check_batch(
            num_steps=self.rollout.num_steps,
            num_worlds=self.num_trained_envs,
            whole_worlds=self.policy.recurrent != "none",
        )

    def check_follows(self, before: TrainConfig, changed: Collection[str]) -> None:
        """Raises ConfigError where the parameters of an earlier phase cannot go on, or a setting that changed is not
        used."""
        checks.check_same_shapes(before.env, self.env, self.policy)
        checks.check_changed_reward(changed, self.env)

    @functools.cached_property
    def schedule(self) -> Schedule[TrainConfig]:
        """The configuration of each update. Raises ValueError, one line, for phases that cannot run."""
        return Schedule(self)

    @functools.cached_property
    def refresh_times(self) -> RefreshTimes:
        """Updates of refreshes of the curriculum. Raises ValueError, one line, for phases that cannot run."""
        return refresh_times(self.schedule.phases, policy_lag=self.run.policy_lag)

    @property
    def has_curator(self) -> bool:
        """Levels are scored in some phase: by curators in the background, or by workers between updates."""
        return any(phase.config.curriculum_class.refreshes for phase in self.schedule.phases)

    @property
    def workers_curate(self) -> bool:
        """Workers score levels, between updates."""
        return self.has_curator and self.run.num_curators == 0

    @property
    def evaluates_in_background(self) -> bool:
        """An evaluator works while training goes on."""
        return self.run.placement != "local" and (self.evaluation.is_during_training or self.recording.every > 0)

    @property
    def num_blocks(self) -> int:
        """Blocks of worlds that can lie on different devices: each of whole groups and whole virtual shards."""
        return math.gcd(self.rollout.num_groups, self.ppo.virtual_shards)

    def groups_of_part(self, part: int, num_parts: int) -> range:
        """World groups of a rollout actor; the first ones have one more where they cannot be shared evenly."""
        least, more = divmod(self.rollout.num_groups, num_parts)
        first = part * least + min(part, more)
        return range(first, first + least + (part < more))

    @property
    def num_trained_envs(self) -> int:
        """Worlds that the policy learns from, over all devices."""
        rollout = self.rollout
        return rollout.num_groups * self.curriculum_class.num_trained(self.curriculum, rollout.worlds_per_group)

    @property
    def curriculum_class(self) -> type[Curriculum]:
        """Raises ValueError for a curriculum that is unknown or cannot run with this configuration."""
        return curriculum_class(self.curriculum, self.rollout.worlds_per_group)

    @property
    def hash(self) -> str:
        """16 hexadecimal digits over `numbers_of(self)`."""
        text = json_text(numbers_of(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclasses.dataclass(frozen=True, kw_only=True)
class StoredConfig:
    """Settings of a checkpoint by which its policy plays: no path, and no part that only training uses."""

    env: EnvConfig
    policy: PolicyConfig
    plugins: tuple[str, ...] = ()  # modules that register parts of these, which the user trusts

    def __post_init__(self) -> None:
        check_finite(self)


# Settings that came later, with the value at which a run is what it was before them: then they are no part of its hash,
# and runs of earlier versions go on.
_NEUTRAL = {
    ("curriculum", "filter_noop"): True,
    ("rollout", "reset_every"): 1,
    ("ppo", "noise_scale"): False,
    ("env.physics", "line_search"): False,
}


def numbers_of(config: TrainConfig) -> dict[str, Any]:
    """Settings that the parameters after k updates depend on, as plain values."""
    sections = to_dict(config)
    counted = {name: sections[name] for name in ("env", "policy", "ppo", "curriculum", "rollout")}
    read = {section for phase in config.schedule.phases for section in phase.config.curriculum_class.sections}
    for section in OWN_SECTIONS:
        if section not in read:
            del counted["curriculum"][section]
    for (section, field), neutral in _NEUTRAL.items():
        place = functools.reduce(operator.getitem, section.split("."), counted)
        if place[field] == neutral:
            del place[field]
    del counted["env"]["shaping_discount"]  # where it counts it is ppo.discount
    counted["env"] = _before_rewards(counted["env"], usual=to_dict(EnvConfig()))
    phases = numbers_of_phases(config.schedule, config.phases)
    counted["phases"] = [_before_rewards(phase, usual=UNCHANGED) for phase in phases]
    run: dict[str, Any] = {"seed": config.run.seed, "policy_lag": config.run.policy_lag}
    run |= {"start_from": config.run.start_from, "start_optimizer": config.run.start_optimizer}
    if config.run.imitation_steps:
        run["imitation_steps"] = config.run.imitation_steps
        if config.imitation != ImitationConfig():  # which came later
            run["imitation"] = to_dict(config.imitation)
    return counted | {"run": run}


def _before_rewards(settings: Mapping[str, Any], *, usual: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of `env` or of a phase in the words from before `env.reward`, so that runs from then go on.

    The reward was "dense", or "sparse" where `dense_reward_scale` was 0, which no configuration of today has. usual: of
    both, where nobody sets them.
    """
    before = {name: value for name, value in settings.items() if name != "reward"}
    if settings["reward"] == usual["reward"]:
        return before
    if settings["reward"] == "sparse" and settings["dense_reward_scale"] == usual["dense_reward_scale"]:
        return before | {"dense_reward_scale": 0.0}
    return dict(settings)


def differences(ours: TrainConfig, theirs: TrainConfig) -> list[str]:
    """Fields that change the numbers and differ, as "ppo.epochs 8 instead of 4"."""
    # What one of them leaves out or says in older words has its value of today in the whole config.
    left, right = ({**flat(numbers_of(config)), **flat(to_dict(config))} for config in (ours, theirs))
    counted = {*flat(numbers_of(ours)), *flat(numbers_of(theirs)), "env.reward"}
    return in_words({name: (left.get(name), right.get(name)) for name in counted})
