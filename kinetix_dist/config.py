"""What a run is: one frozen dataclass whose sections are the configs of the parts. What is printed is what runs.

`TrainConfig` goes to `config.json` of a run directory and back. Its hash covers what changes the numbers (not: how
long, where to, how often it is evaluated or saved); a checkpoint carries it and is only resumed by a config of the
same hash.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import operator
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from jax2d.settings import preset
from kinetix_dist.curator.config import OWN_SECTIONS, CurriculumConfig
from kinetix_dist.curator.curricula import curriculum_class
from kinetix_dist.curator.curriculum import Curriculum
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.level.level import SIZES
from kinetix_dist.level.mechanisms import FAMILIES, fitting_families
from kinetix_dist.level.size_mixture import sizes_drawn
from kinetix_dist.models.colour_readout import check_heads
from kinetix_dist.models.policy import NETWORKS, PolicyConfig
from kinetix_dist.phases import PhaseConfig, Schedule
from kinetix_dist.registry import import_plugins
from kinetix_dist.renamed_settings import RenamedSettingError, translated
from kinetix_dist.telemetry.curriculum_log import CurriculumLogConfig

PLACEMENTS = ("local", "colocated", "split")
DEVICES = ("auto", "cpu", "gpu")
LAST_PORT = 65535
NUM_SEEDS = 1 << 32  # JAX takes seeds modulo this, without 64-bit numbers


class ConfigError(ValueError):
    """A configuration that cannot run, with the field and the value."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RolloutConfig:
    """How much is played for one update."""

    num_envs: int = 2048  # worlds, over all devices
    num_steps: int = 256  # environment steps of each world in an update
    num_groups: int = 64  # of worlds, with levels drawn from a key each; no more devices can play

    def __post_init__(self) -> None:
        for name in ("num_envs", "num_steps", "num_groups"):
            if getattr(self, name) < 1:
                raise ConfigError(f"RolloutConfig.{name} is {getattr(self, name)}; it must be 1 or more")
        if self.num_envs % self.num_groups:
            raise ConfigError(
                f"RolloutConfig.num_envs {self.num_envs} is not a multiple of num_groups {self.num_groups}; change one"
            )

    @property
    def worlds_per_group(self) -> int:
        return self.num_envs // self.num_groups

    @property
    def steps_per_group(self) -> int:
        return self.worlds_per_group * self.num_steps

    @property
    def steps_per_update(self) -> int:
        return self.num_envs * self.num_steps


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """Solve rates before and after training, and during it. None of these levels is trained on."""

    sets: tuple[str, ...] = ("random_s", "designed_s")
    attempts: int = 1  # first episodes of each level
    min_attempts: int = 100  # of a set; the levels of a smaller one are tried more often
    every: int = 0  # updates between evaluations during training; 0: only before and after
    every_seconds: float = 0.0  # the same in seconds of training after its warm-up; 0: by updates

    def __post_init__(self) -> None:
        for name, least in (("attempts", 1), ("min_attempts", 0), ("every", 0), ("every_seconds", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"EvaluationConfig.{name} is {getattr(self, name)}; it must be {least} or more")
        if not self.sets:
            raise ConfigError("EvaluationConfig.sets is empty; name at least one level set")
        if self.every and self.every_seconds:
            raise ConfigError(
                f"EvaluationConfig has every {self.every} and every_seconds {self.every_seconds:g}; "
                "set one of them to 0"
            )

    @property
    def is_during_training(self) -> bool:
        """And not only before and after."""
        return self.every > 0 or self.every_seconds > 0

    def attempts_of(self, num_levels: int) -> int:
        """Of each level of a set of so many; small sets are tried more often, since few attempts say little."""
        return max(self.attempts, math.ceil(self.min_attempts / num_levels))


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordingConfig:
    """Rollouts on the evaluation sets that are written to recordings/*.mcap."""

    num_rollouts: int = 8  # recorded after training; 0: none
    every: int = 0  # updates between recordings during training; 0: only after
    make_pictures: bool = True  # after training: .rrd and .png of a solved and of a failed rollout

    def __post_init__(self) -> None:
        if self.num_rollouts < 0 or self.every < 0:
            raise ConfigError(
                f"RecordingConfig has num_rollouts {self.num_rollouts}, every {self.every}; neither may be negative"
            )


@dataclasses.dataclass(frozen=True, kw_only=True)
class LimitsConfig:
    """Seconds that sections of a run may take, before processes that have not answered are taken for lost."""

    start: float = 600.0  # starting processes, loading levels and checkpoint
    recover: float = 600.0  # the same after a loss
    compile: float = 1800.0  # more for those that compile, at the first update, curate, evaluate, record after a start
    update: float = 600.0  # one update, without evaluation and saving
    curate: float = 1800.0  # one refresh of the curriculum, where training waits for it
    evaluate: float = 1800.0  # one evaluation of all sets
    record: float = 1800.0  # one recording
    save: float = 600.0  # copying a checkpoint off the devices
    report: float = 120.0  # facts for report.json

    def __post_init__(self) -> None:
        for name, value in dataclasses.asdict(self).items():
            if not value > 0:
                raise ConfigError(f"LimitsConfig.{name} is {value}; it must be above 0")


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """How long, where and from which seed."""

    name: str = "run"  # directory below runs/ when --run is not given
    seed: int = 0
    start_from: str = ""  # checkpoint or pretrained policy whose parameters training starts from; "": from the seed
    start_optimizer: bool = False  # take the state of its optimiser, too
    start_other_engine: bool = False  # also where it learned with other settings of the engine than this run
    total_env_steps: int = 0  # training ends at the first update that reaches it; 0: no such end
    max_seconds: float = 0.0  # training ends at the first update after so much training time; 0: no such end
    placement: str = "colocated"  # "local" (no ray), "colocated" or "split"
    device: str = "auto"  # "auto" (gpu if there is one), "cpu" or "gpu"
    num_workers: int = 0  # colocated placement: processes that play and learn; 0: one a GPU, on CPU one
    num_learners: int = 1  # split placement: processes that learn together
    num_rollout_actors: int = 1  # split placement: processes that play
    num_cpu_rollout_actors: int = 0  # of these, how many play on CPUs although the run uses GPUs
    num_curators: int = 1  # that share a refresh, at most one a GPU that plays; 0: workers do it between updates
    min_workers: int = 1  # or rollout actors, with which to go on while nodes are lost; with fewer it waits
    node_wait_seconds: float = 60.0  # for a lost node to come back, before going on with fewer
    gpu_memory_gib: float = 0.0  # of each GPU, for all processes of the run; 0: all there is
    curator_memory_gib: float = 0.0  # of that, for a curator; 0: by scoring_batch and size
    checkpoint_every: int = 50  # updates
    keep_checkpoints: int = 3
    max_restarts: int = 20  # of lost processes within an hour, before the run gives up
    max_skipped_updates: int = 5  # in a row, for gradients that are not finite, before going back to a checkpoint
    heartbeat_seconds: float = 60.0  # a process that was silent for so long, outside of compilation, is taken for hung
    limits: LimitsConfig = dataclasses.field(default_factory=LimitsConfig)
    metrics_port: int = 0  # on loopback, where Prometheus finds the metrics; 0: none
    stop_seconds: float = 25.0  # after SIGTERM or Ctrl-C, for the update in progress, its checkpoint and the end of Ray
    plugins: tuple[str, ...] = ()  # modules that register parts of your own; every process of the run imports them
    compile_cache: str = ""  # directory of compiled programs; "": the user's cache directory; "off": none

    def __post_init__(self) -> None:
        for name, allowed in (("placement", PLACEMENTS), ("device", DEVICES)):
            if getattr(self, name) not in allowed:
                raise ConfigError(f"RunConfig.{name} is {getattr(self, name)!r}; choose from {', '.join(allowed)}")
        for name, least in (
            ("total_env_steps", 0),
            ("max_seconds", 0),
            ("num_workers", 0),
            ("num_learners", 1),
            ("num_rollout_actors", 1),
            ("num_cpu_rollout_actors", 0),
            ("num_curators", 0),
            ("min_workers", 1),
            ("node_wait_seconds", 0),
            ("gpu_memory_gib", 0),
            ("curator_memory_gib", 0),
            ("checkpoint_every", 1),
            ("keep_checkpoints", 1),
            ("max_restarts", 0),
            ("max_skipped_updates", 1),
            ("stop_seconds", 0),
            ("metrics_port", 0),
        ):
            value = getattr(self, name)
            if not value >= least or value == math.inf:  # nor is it NaN
                raise ConfigError(f"RunConfig.{name} is {value}; it must be a number, {least} or more")
        if not 0 < self.heartbeat_seconds < math.inf:
            raise ConfigError(f"RunConfig.heartbeat_seconds is {self.heartbeat_seconds}; it must be above 0")
        if not 0 <= self.seed < NUM_SEEDS:
            raise ConfigError(f"RunConfig.seed is {self.seed}; it must be 0 to {NUM_SEEDS - 1}: others give the same")
        if self.num_cpu_rollout_actors > self.num_rollout_actors:
            raise ConfigError(
                f"RunConfig.num_cpu_rollout_actors is {self.num_cpu_rollout_actors}, of num_rollout_actors "
                f"{self.num_rollout_actors} in all; lower the one or raise the other"
            )
        if self.start_optimizer and not self.start_from:
            raise ConfigError(
                "RunConfig.start_optimizer is True, but start_from names no checkpoint; give one (--from), or leave it"
            )
        if self.metrics_port > LAST_PORT:
            raise ConfigError(f"RunConfig.metrics_port is {self.metrics_port}; it must be {LAST_PORT} or less")
        if not self.total_env_steps and not self.max_seconds:
            raise ConfigError("RunConfig has neither total_env_steps nor max_seconds; give one, or the run never ends")

    @property
    def policy_lag(self) -> int:
        """Updates between the policy that acts and the policy that is updated."""
        return 1 if self.placement == "split" else 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Everything a training run depends on, section by section."""

    env: EnvConfig = dataclasses.field(default_factory=EnvConfig)
    policy: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    ppo: PpoConfig = dataclasses.field(default_factory=PpoConfig)
    curriculum: CurriculumConfig = dataclasses.field(default_factory=CurriculumConfig)
    rollout: RolloutConfig = dataclasses.field(default_factory=RolloutConfig)
    evaluation: EvaluationConfig = dataclasses.field(default_factory=EvaluationConfig)
    recording: RecordingConfig = dataclasses.field(default_factory=RecordingConfig)
    curriculum_log: CurriculumLogConfig = dataclasses.field(default_factory=CurriculumLogConfig)
    phases: tuple[PhaseConfig, ...] = ()  # from a step on, other settings; the sections above hold until the first
    run: RunConfig

    def __post_init__(self) -> None:
        check_finite(self)
        order = list(SIZES)
        if too_large := [
            size for size in sizes_drawn(self.curriculum.sizes) if order.index(size) > order.index(self.env.size)
        ]:
            raise ConfigError(
                f"curriculum.sizes has {too_large[-1]!r}, which does not fit env.size {self.env.size!r}, the size of "
                f"the arrays; set env.size to {too_large[-1]!r}"
            )
        if ACTION_SPACES[self.env.action_space].distribution is None:
            trainable = [name for name in ACTION_SPACES if ACTION_SPACES[name].distribution is not None]
            raise ConfigError(
                f"env.action_space is {self.env.action_space!r}: environments have it, but no policy can be trained "
                f"for it; use {' or '.join(map(repr, trainable))}"
            )
        if self.ppo.mask_unbound_heads and not ACTION_SPACES[self.env.action_space].has_bound_heads:
            raise ConfigError(
                f"ppo.mask_unbound_heads is True, but no dimension of {self.env.action_space!r} actions is of one "
                "colour; set it to False or use another env.action_space"
            )
        if self.policy.read_out == "colour":
            check_heads(ACTION_SPACES[self.env.action_space].distribution.head_sizes)
        gives, takes = OBSERVATIONS[self.env.observation].gives, NETWORKS[self.policy.network].takes
        if gives != takes:
            fitting = [name for name in NETWORKS if NETWORKS[name].takes == gives]
            advice = f"use policy.network {' or '.join(map(repr, fitting))}" if fitting else "change one of them"
            raise ConfigError(
                f"env.observation {self.env.observation!r} gives {gives}, but policy.network {self.policy.network!r} "
                f"takes {takes}; {advice}"
            )
        num_episodes = self.curriculum_class.num_episodes(self.curriculum)
        if self.rollout.num_steps < num_episodes * self.env.max_steps:
            needs = "the end of an episode" if num_episodes == 1 else f"the ends of {num_episodes} episodes"
            what = f" with plr.score {self.curriculum.plr.score!r}" if num_episodes > 1 else ""
            raise ConfigError(
                f"curriculum {self.curriculum.name!r}{what} needs {needs} in every world of an update, but "
                f"rollout.num_steps is {self.rollout.num_steps} and env.max_steps {self.env.max_steps}; raise the one "
                "or lower the other"
            )
        if self.curriculum_class.scores_by_steps and self.curriculum.scoring_steps < self.env.max_steps:
            raise ConfigError(
                f"curriculum.scoring_steps is {self.curriculum.scoring_steps} and env.max_steps {self.env.max_steps}: "
                "of a level whose episodes end at the time limit none would end while it is scored, and the buffer "
                "would fill with what fails early; raise the one or lower the other"
            )
        if self.run.num_curators > 1 and not self.curriculum_class.shares_refresh:
            raise ConfigError(
                f"run.num_curators is {self.run.num_curators}, but nothing of curriculum {self.curriculum.name!r} can "
                "be shared by several; set it to 1"
            )
        if self.run.num_curators > self.curriculum.num_batches:
            raise ConfigError(
                f"run.num_curators is {self.run.num_curators}, but candidates are scored in batches of "
                f"curriculum.scoring_batch {self.curriculum.scoring_batch}, {self.curriculum.num_batches} in all: some "
                "would have none; lower it or scoring_batch"
            )
        if self.workers_curate and self.run.placement == "split":
            raise ConfigError(
                "run.num_curators is 0, but in placement split no process both learns and plays, so none can score "
                "levels between updates; set it to 1 or use run.placement colocated"
            )
        if self.run.placement == "split" and self.run.num_rollout_actors > self.rollout.num_groups:
            raise ConfigError(
                f"{self.run.num_rollout_actors} rollout actors cannot share {self.rollout.num_groups} world groups: "
                "some would have none; lower run.num_rollout_actors or raise rollout.num_groups"
            )
        if self.phases:
            self.check_batch()
            _ = self.schedule  # raises for phases that cannot run

    @property
    def cut_episodes(self) -> str:
        """A line about episodes that an update does not play to their end; "": there are none."""
        num_steps, max_steps = self.rollout.num_steps, self.env.max_steps
        if num_steps >= max_steps:
            return ""
        return (
            f"rollout.num_steps is {num_steps} and env.max_steps {max_steps}: every update begins its levels anew, so "
            f"that what comes after step {num_steps} of an episode is never learned from; raise the one or lower the "
            "other"
        )

    def check_generator(self) -> None:
        """Raises ConfigError where a size of levels has no room for any of the mechanism families."""
        generator = self.curriculum.generator
        for size in sizes_drawn(self.curriculum.sizes) or [self.env.size]:
            if generator.mechanism_share and not fitting_families(generator.mechanism_families, SIZES[size]):
                named = ", ".join(generator.mechanism_families) or "()"
                raise ConfigError(
                    f"curriculum.generator.mechanism_families {named}: levels of size "
                    f"{size!r} have room for none; add one of "
                    f"{', '.join(fitting_families(list(FAMILIES), SIZES[size]))}, or use a larger size"
                )

    def check_batch(self) -> None:
        """Raises ValueError, with the numbers, where what is played in an update cannot be divided as asked."""
        self.ppo.check_batch(
            num_steps=self.rollout.num_steps,
            num_worlds=self.num_trained_envs,
            whole_worlds=self.policy.recurrent != "none",
        )

    @functools.cached_property
    def schedule(self) -> Schedule:
        """Which configuration holds in which update. Raises ValueError, one line, for phases that cannot run."""
        return Schedule(self)

    @property
    def has_curator(self) -> bool:
        """Whether levels are scored: by curators beside training, or by workers between updates."""
        return self.curriculum_class.refreshes

    @property
    def workers_curate(self) -> bool:
        """Whether workers score levels, between updates."""
        return self.has_curator and self.run.num_curators == 0

    @property
    def evaluates_in_background(self) -> bool:
        """Whether an evaluator works beside training."""
        return self.run.placement != "local" and (self.evaluation.is_during_training or self.recording.every > 0)

    @property
    def num_blocks(self) -> int:
        """Of worlds, each of whole groups and whole virtual shards: what can lie on different devices."""
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
        text = json.dumps(numbers_of(self), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def check_finite(section: Any, field: str = "") -> None:
    """Raises ConfigError for a float of a dataclass, or of what is in it, that is not finite."""
    if isinstance(section, float) and not math.isfinite(section):
        raise ConfigError(f"{field} is {section}; it must be a finite number")
    items: Iterable[tuple[Any, Any]] = ()
    if isinstance(section, tuple | list):
        items = enumerate(section)
    elif isinstance(section, Mapping):
        items = section.items()
    elif dataclasses.is_dataclass(section):
        items = [(each.name, getattr(section, each.name)) for each in dataclasses.fields(section)]
    for name, item in items:
        check_finite(item, f"{field}.{name}".removeprefix("."))


# Fields that `numbers_of` leaves out while they are off, so that hashes are those of versions without them.
_OFF = {
    "env.failure_penalty": 1.0,
    "policy.read_out": "pooled",
    "policy.max_qk_norm": 0.0,
    "curriculum.sizes": [],
    "curriculum.generator.varied_share": 0.0,
    "curriculum.generator.mechanism_weights": [],
    "curriculum.learnable_only": False,
}


def numbers_of(config: TrainConfig) -> dict[str, Any]:
    """What the parameters after k updates depend on."""
    sections = to_dict(config)
    kept = {name: sections[name] for name in ("env", "policy", "ppo", "curriculum", "rollout")}
    if config.policy.recurrent == "none":  # hashes are those of versions without memory
        del kept["policy"]["recurrent"], kept["policy"]["memory_size"]
    del kept["env"]["effect_groups"]  # a matter of time: engines agree bit for bit within their effects
    for section in OWN_SECTIONS:
        if section not in config.curriculum_class.sections:
            del kept["curriculum"][section]
    for name, off in _OFF.items():
        *path, field = name.split(".")
        section = functools.reduce(operator.getitem, path, kept)
        if section[field] == off:
            del section[field]
    if config.phases:
        kept["phases"] = [
            {name: value for name, value in phase.items() if value is not None} for phase in sections["phases"]
        ]
    start = {"start_from": config.run.start_from} if config.run.start_from else {}
    if config.run.start_optimizer:
        start["start_optimizer"] = True
    return kept | {"run": {"seed": config.run.seed, "policy_lag": config.run.policy_lag} | start}


def differences(ours: TrainConfig, theirs: TrainConfig) -> list[str]:
    """Fields that change the numbers and differ, as "ppo.epochs 8 instead of 4"."""
    # What is left out of the numbers while it is off has its value in the whole config.
    left, right = ({**flat(to_dict(config)), **flat(numbers_of(config))} for config in (ours, theirs))
    counted = flat(numbers_of(ours)) | flat(numbers_of(theirs))
    return _in_words({name: (left.get(name), right.get(name)) for name in counted})


def differing(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> list[str]:
    """The same of nested dictionaries of plain values."""
    left, right = flat(ours), flat(theirs)
    return _in_words({name: (left.get(name), right.get(name)) for name in left | right})


def _in_words(values: Mapping[str, tuple[Any, Any]]) -> list[str]:
    return [f"{name} {left!r} instead of {right!r}" for name, (left, right) in sorted(values.items()) if left != right]


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain JSON types."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(data: Mapping[str, Any]) -> TrainConfig:
    """The inverse of `to_dict`; raises ConfigError for a field that is unknown or of another type, and for a config of
    a version that kept the name of a preset instead of its numbers."""
    if (name := _old_preset(data)) is not None:
        raise ConfigError(
            f"this config is of an older version: it names the solver preset {name!r} (env.preset) instead of its "
            "numbers (env.physics), and these may have changed since, so that training cannot go on from it; "
            "start a new run (`kinetix-dist eval` still plays the old policy)"
        )
    import_plugins(data.get("run", {}).get("plugins", ()))
    return build(TrainConfig, _with_todays_names(data))


def _with_todays_names(data: Mapping[str, Any], *, for_playing: bool = False) -> dict[str, Any]:
    try:
        return translated(data, for_playing=for_playing)
    except RenamedSettingError as error:
        raise ConfigError(f"this config is of an older version: {error}") from error


def has_same_numbers(config: TrainConfig, stored: Mapping[str, Any], stored_hash: str) -> bool:
    """Whether training goes on with `config` as with a stored one: they have the same hash, at once or with today's
    names of its settings. A setting that it lacks makes it another version, whatever its value is now."""
    if stored_hash == config.hash:
        return True
    try:
        data = _with_todays_names(stored)
        theirs = from_dict(stored)
    except ValueError:
        return False
    return flat(to_dict(theirs)).keys() == flat(data).keys() and theirs.hash == config.hash


def with_phases(config: TrainConfig, phases: Sequence[Mapping[str, Any]]) -> TrainConfig:
    """The config with these phases, given as plain values, in place of its own. Raises ValueError, one line."""
    built = tuple(build(PhaseConfig, phase, f"phases.{number}") for number, phase in enumerate(phases))
    return dataclasses.replace(config, phases=built)


def from_dict_for_playing(data: Mapping[str, Any]) -> TrainConfig:
    """The same for what is only played: on any device, and where an older config has the name of a preset, with
    today's numbers of it."""
    if (name := _old_preset(data)) is not None:
        env = {field: value for field, value in data["env"].items() if field != "preset"}
        data = {**data, "env": {**env, "physics": to_dict(preset(name))}}
    curriculum, env = data.get("curriculum"), data.get("env")
    if isinstance(curriculum, Mapping) and isinstance(env, Mapping):
        # Older versions trained with settings by which levels are scored that are refused now; what is only played
        # scores nothing.
        steps, least, replay = curriculum.get("scoring_steps"), env.get("max_steps"), curriculum.get("plr")
        if isinstance(steps, int) and isinstance(least, int) and steps < least:
            curriculum = {**curriculum, "scoring_steps": least}
        if isinstance(replay, Mapping):
            curriculum = {**curriculum, "plr": {name: value for name, value in replay.items() if name != "score"}}
        data = {**data, "curriculum": curriculum}
    data = _with_todays_names(data, for_playing=True)
    policy = data.get("policy")
    if isinstance(policy, Mapping) and policy.get("kernels") == "fused":  # also of a network that has no kernels
        data = {**data, "policy": {**policy, "kernels": "auto"}}
    return from_dict(data)


def _old_preset(data: Mapping[str, Any]) -> str | None:
    """The name of a preset in a config of a version before `EnvConfig.physics`."""
    env = data.get("env")
    return env.get("preset") if isinstance(env, Mapping) and "physics" not in env else None


def build(kind: Any, data: Any, where: str = "") -> Any:
    """A value of a field of type `kind`, a config dataclass say, from types of JSON or TOML. Raises ConfigError for a
    field that is unknown, missing or of another type; `where` is its name."""
    if dataclasses.is_dataclass(kind):
        if not isinstance(data, Mapping):
            raise ConfigError(f"config field {where or 'top level'} is {data!r}; an object is needed")
        hints = typing.get_type_hints(kind)
        names = {field.name for field in dataclasses.fields(kind)}
        if unknown := sorted(set(data) - names):
            raise ConfigError(
                f"config field {_join(where, unknown[0])} is unknown; fields are {', '.join(sorted(names))}"
            )
        needed = [
            field.name
            for field in dataclasses.fields(kind)
            if field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        ]
        if missing := [name for name in needed if name not in data]:
            raise ConfigError(f"config field {_join(where, missing[0])} is missing")
        return kind(**{name: build(hints[name], value, _join(where, name)) for name, value in data.items()})
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        if not isinstance(data, list | tuple):
            raise ConfigError(f"config field {where} is {data!r}; a list is needed")
        inner = arguments[0] if len(arguments) == 2 and arguments[1] is Ellipsis else Any
        return tuple(build(inner, value, where) for value in data)
    if origin in (typing.Union, types.UnionType):
        if data is None:
            return None
        return build(next(option for option in arguments if option is not types.NoneType), data, where)
    if kind is float and isinstance(data, int) and not isinstance(data, bool):
        return float(data)
    if kind in (int, float, str, bool) and type(data) is not kind:
        raise ConfigError(f"config field {where} is {data!r}; {kind.__name__} is needed")
    return data


def _join(where: str, name: str) -> str:
    return f"{where}.{name}" if where else name


def flat(data: Mapping[str, Any], where: str = "") -> dict[str, Any]:
    """Fields of nested sections by their full names: {"ppo.epochs": 8, ...}."""
    fields = {}
    for name, value in data.items():
        fields |= flat(value, _join(where, name)) if isinstance(value, Mapping) else {_join(where, name): value}
    return fields
