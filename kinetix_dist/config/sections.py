"""Sections of a run's configuration that belong to the run itself: playing, evaluation, recording, time and processes.

The others stand beside their component (`EnvConfig`, `PpoConfig`, ...)."""

from __future__ import annotations

import dataclasses
import math

from kinetix_dist.setting import ConfigError, check_settings, setting
from kinetix_dist.telemetry.sinks import SINKS

PLACEMENTS = ("local", "colocated", "split")
DEVICES = ("auto", "cpu", "gpu")
LAST_PORT = 65535
LAST_SEED = (1 << 32) - 1  # JAX takes seeds modulo 2^32, without 64-bit numbers


@dataclasses.dataclass(frozen=True, kw_only=True)
class RolloutConfig:
    """Worlds and steps that are played for one update."""

    num_envs: int = setting(2048, minimum=1)  # worlds, over all devices
    num_steps: int = setting(256, minimum=1)  # environment steps of each world in an update
    num_groups: int = setting(64, minimum=1)  # of worlds, with levels drawn from a key each; no more devices can play
    reset_every: int = setting(1, minimum=1)  # updates from one reset of all worlds, with new levels, to the next

    def __post_init__(self) -> None:
        check_settings(self)
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

    @property
    def steps_between_resets(self) -> int:
        """Environment steps of each world on its level."""
        return self.num_steps * self.reset_every

    def last_reset(self, update: int) -> int:
        """The update that began with the reset by which its worlds, and those of `update`, got their levels."""
        return update - update % self.reset_every

    def resets_before(self, update: int) -> bool:
        """An update begins with new levels; otherwise its worlds go on from the update before."""
        return self.last_reset(update) == update


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """Solve rates before and after training, and during it. None of these levels is trained on."""

    sets: tuple[str, ...] = ("random_s", "designed_s")
    attempts: int = setting(1, minimum=1)  # first episodes of each level
    min_attempts: int = setting(100, minimum=0)  # of a set; the levels of a smaller one are tried more often
    every: int = setting(0, minimum=0)  # updates between evaluations during training; 0: only before and after
    every_seconds: float = setting(0.0, minimum=0)  # the same in seconds of training after its warm-up; 0: by updates

    def __post_init__(self) -> None:
        check_settings(self)
        if not self.sets:
            raise ConfigError("EvaluationConfig.sets is empty; name at least one level set")
        if self.every and self.every_seconds:
            raise ConfigError(
                f"EvaluationConfig has every {self.every} and every_seconds {self.every_seconds:g}; "
                "set one of them to 0"
            )

    @property
    def is_during_training(self) -> bool:
        """Evaluated during training, not only before and after."""
        return self.every > 0 or self.every_seconds > 0

    def attempts_of(self, num_levels: int) -> int:
        """Attempts at each level of a set of `num_levels`; more in small sets, since few attempts say little."""
        return max(self.attempts, math.ceil(self.min_attempts / num_levels))


@dataclasses.dataclass(frozen=True, kw_only=True)
class RecordingConfig:
    """Rollouts on the evaluation sets that are written to recordings/*.mcap."""

    num_rollouts: int = setting(8, minimum=0)  # recorded after training; 0: none
    every: int = setting(0, minimum=0)  # updates between recordings during training; 0: only after
    make_pictures: bool = True  # after training: .rrd and .png of a solved and of a failed rollout

    def __post_init__(self) -> None:
        check_settings(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImitationConfig:
    """Imitation before the first update, `run.imitation_steps` gradient steps of it: of proofs or of a data set."""

    data: str = ""  # data set that is imitated; "": the proofs of curriculum.levels
    batch_size: int = setting(128, minimum=1)  # samples of a gradient step
    learning_rate: float = setting(5e-4, above=0)  # at first; it falls to 0 linearly
    class_balance: float = setting(0.0, minimum=0, maximum=1)  # 1: rare choices of an action weigh as much as common
    held_out: float = setting(0.1, minimum=0, below=1)  # share of the levels that is left out, to score on; 0: none
    every: int = setting(250, minimum=1)  # gradient steps between evaluations on them
    patience: int = setting(0, minimum=0)  # evaluations with no more actions alike, after which it stops; 0: never
    skip_damaged: bool = False  # leave out shards of a data set that are damaged or missing, and count them

    def __post_init__(self) -> None:
        check_settings(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LimitsConfig:
    """Seconds that sections of a run may take, before processes that have not answered are taken for lost."""

    start: float = setting(600.0, above=0)  # starting processes, loading levels and checkpoint
    recover: float = setting(600.0, above=0)  # the same after a loss
    compile: float = setting(1800.0, above=0)  # more for the first update, curate, evaluate, record after a start
    update: float = setting(600.0, above=0)  # one update, without evaluation and saving
    curate: float = setting(1800.0, above=0)  # one refresh of the curriculum, where training waits for it
    evaluate: float = setting(1800.0, above=0)  # one evaluation of all sets
    record: float = setting(1800.0, above=0)  # one recording
    save: float = setting(600.0, above=0)  # copying a checkpoint off the devices
    report: float = setting(120.0, above=0)  # facts for report.json

    def __post_init__(self) -> None:
        check_settings(self)


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Length, place, processes and seed of a run."""

    name: str = "run"  # directory below runs/ when --run is not given
    seed: int = setting(0, minimum=0, maximum=LAST_SEED)
    start_from: str = ""  # checkpoint or pretrained policy whose parameters training starts from; "": from the seed
    start_optimizer: bool = False  # take the state of its optimiser, too
    imitation_steps: int = setting(0, minimum=0)  # gradient steps of imitation before training, see `imitation`
    start_other_engine: bool = False  # also where it learned with other settings of the engine than this run
    total_env_steps: int = setting(0, minimum=0)  # after which training ends; 0: no such end
    max_seconds: float = setting(0.0, minimum=0)  # of training time, after which it ends; 0: no such end
    only_updates: bool = False  # no evaluation, recording or checkpoint: for measurements of speed
    warmup_counts: bool = True  # max_seconds has the first update of each session in it, which compiles
    stop_at: float = setting(0.0, minimum=0, maximum=1)  # solve rate of each evaluation set that ends training; 0: none
    placement: str = setting("colocated", choices=PLACEMENTS)  # "local" (no ray), "colocated" or "split"
    device: str = setting("auto", choices=DEVICES)  # "auto" (gpu if there is one), "cpu" or "gpu"
    num_workers: int = setting(0, minimum=0)  # colocated: processes that play and learn; 0: one per GPU, on CPU one
    num_learners: int = setting(1, minimum=1)  # split: processes that learn together
    num_rollout_actors: int = setting(1, minimum=1)  # split: processes that play
    num_cpu_rollout_actors: int = setting(0, minimum=0)  # of these, on CPUs although the run uses GPUs
    num_curators: int = setting(1, minimum=0)  # processes that share a refresh; 0: workers do it between updates
    min_workers: int = setting(1, minimum=1)  # or rollout actors; with fewer, as nodes are lost, it waits
    node_wait_seconds: float = setting(60.0, minimum=0)  # for a lost node to come back, before going on with fewer
    gpu_memory_gib: float = setting(0.0, minimum=0)  # of each GPU, for all processes of the run; 0: all there is
    curator_memory_gib: float = setting(0.0, minimum=0)  # of that, for a curator; 0: by scoring_batch and size
    checkpoint_every: int = setting(50, minimum=1)  # updates
    keep_checkpoints: int = setting(3, minimum=1)
    max_restarts: int = setting(20, minimum=0)  # of lost processes within an hour, before the run gives up
    max_skipped_updates: int = setting(5, minimum=1)  # in a row, before going back to a checkpoint
    heartbeat_seconds: float = setting(60.0, above=0)  # silence after which a process is taken for hung
    limits: LimitsConfig = dataclasses.field(default_factory=LimitsConfig)
    metrics_port: int = setting(0, minimum=0, maximum=LAST_PORT)  # on loopback, for Prometheus; 0: none
    stop_seconds: float = setting(25.0, minimum=0)  # after SIGTERM or Ctrl-C, until all has ended
    sinks: tuple[str, ...] = ("tensorboard",)  # what gets metrics, evaluations and events, besides the run's own files
    plugins: tuple[str, ...] = ()  # modules that register parts of your own
    compile_cache: str = ""  # directory of compiled programs; "": the user's cache directory; "off": none

    def __post_init__(self) -> None:
        check_settings(self)
        for name in self.sinks:
            try:
                SINKS[name]
            except ValueError as error:
                raise ConfigError(f"RunConfig.sinks: {error}") from None
        if self.num_cpu_rollout_actors > self.num_rollout_actors:
            raise ConfigError(
                f"RunConfig.num_cpu_rollout_actors is {self.num_cpu_rollout_actors}, of num_rollout_actors "
                f"{self.num_rollout_actors} in all; lower the one or raise the other"
            )
        if self.start_optimizer and not self.start_from:
            raise ConfigError(
                "RunConfig.start_optimizer is True, but start_from names no checkpoint; give one (--from), or leave it"
            )
        if not self.total_env_steps and not self.max_seconds and not self.imitation_steps:
            raise ConfigError("RunConfig has neither total_env_steps nor max_seconds; give one, or the run never ends")

    @property
    def policy_lag(self) -> int:
        """Updates between the policy that acts and the policy that is updated."""
        return 1 if self.placement == "split" else 0
