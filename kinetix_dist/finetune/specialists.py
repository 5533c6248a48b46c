"""Training on one level after another with one set of compiled programs.

    Specialists(config)                    builds the programs: rollout, update, evaluation
    .compile(level, start)                 compiles them, on one level
    .train(level, start) -> Specialist      trains afresh on a level; nothing is compiled again

Levels are the state of the curriculum `fixed`, an argument of the program that plays, and so are parameters: programs
depend on the size of levels alone. Specialists are trained one after another: several at once by
`jax.vmap` are slower on a CPU (docs/lab_log.md).
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from kinetix_dist import prng
from kinetix_dist.checkpoint.manifest import MANIFEST_NAME
from kinetix_dist.config import ConfigError, TrainConfig
from kinetix_dist.errors import UserError
from kinetix_dist.evaluation.evaluate import evaluate
from kinetix_dist.evaluation.policies import NetworkPolicy, Player
from kinetix_dist.learner.sharding import data_mesh, local_values, replicate
from kinetix_dist.level.level import Level
from kinetix_dist.models.policy import make_policy
from kinetix_dist.program_cache import compile_seconds, count_compile_seconds
from kinetix_dist.runtime import (
    EVALUATION_STREAM,
    LearnerCore,
    Players,
    RolloutCore,
    check_memory,
    is_over,
    make_curriculum,
    make_environment,
    training_metrics,
)
from kinetix_dist.trained_policy import Trained, checkpoint_at, newest_checkpoint_of

FROM_SCRATCH = "scratch"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Start:
    """One of the two, or several, that a comparison has."""

    name: str  # of a directory and of a line in pictures
    checkpoint: str = ""  # path, for `run.start_from`; "": the seed
    description: dict[str, Any] | None = None  # of the checkpoint, for lineage; None: the seed

    @property
    def label(self) -> str:
        """Name for a person."""
        return "from scratch" if self.description is None else f"from {self.name}"


SCRATCH = Start(name=FROM_SCRATCH)


def policy_at(path: Path) -> Trained:
    """The checkpoint at a path, the newest good one of a run, or a pretrained policy by name. Raises UserError."""
    if (path / "checkpoints").is_dir():
        return newest_checkpoint_of(path)[0]
    return checkpoint_at(path)


def start_from(trained: Trained) -> Start:
    """The start that a checkpoint is: `runs/quickstart/checkpoints/00000104` is called quickstart-104."""
    checkpoint = trained.checkpoint
    path = checkpoint.path.resolve()
    is_of_run = path.parent.name == "checkpoints" and path.name.isdecimal()
    name = f"{path.parent.parent.name}-{int(path.name)}" if is_of_run else path.name
    if not name:
        raise UserError(f"{path} has no name for results; give a checkpoint in a directory of its own")
    if name == FROM_SCRATCH:
        raise UserError(f"{path} is called {name!r} like a start from the seed; rename the directory")
    description = checkpoint.description
    return Start(
        name=name,
        checkpoint=str(path),
        description={
            "checkpoint": str(path),
            "sha256": hashlib.sha256((path / MANIFEST_NAME).read_bytes()).hexdigest(),  # of the sums of all its files
            "policy_updates": description["num_updates"],
            "env_steps": description.get("env_steps"),
            "config_hash": description.get("config_hash"),
            "start_from": trained.config.run.start_from,  # what that policy was trained from in its turn
        },
    )


def like_policy(config: TrainConfig, trained: Trained) -> TrainConfig:
    """`config` with the network and the environment of a policy, and the modules that its parts come from."""
    theirs = trained.config
    plugins = tuple(dict.fromkeys((*config.run.plugins, *theirs.run.plugins)))
    return dataclasses.replace(
        config, env=theirs.env, policy=theirs.policy, run=dataclasses.replace(config.run, plugins=plugins)
    )


Arrays = Mapping[str, np.ndarray]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One evaluation of a specialist."""

    updates: int
    env_steps: int
    solved: int  # of the attempts
    attempts: int

    @property
    def rate(self) -> float:
        return self.solved / self.attempts


@dataclasses.dataclass(frozen=True, kw_only=True)
class Specialist:
    """A specialist at its end."""

    points: tuple[Point, ...]  # the first before training
    params: Any  # numpy, those for use
    training_seconds: float  # of updates
    evaluation_seconds: float
    compile_seconds: float  # of both: 0 where nothing was compiled again
    skipped_steps: int  # gradient steps left out since they were not finite


class Specialists:
    """Trains on single levels of the set `config.curriculum.levels`, one after another, on one device.

    A specialist ends as a run does, after `run.total_env_steps` or `run.max_seconds`, or at the first evaluation
    whose solve rate is `stop_at` (0: none). Evaluations are every `evaluation.every` updates and at the end.
    Raises ValueError, DeviceMemoryError for what cannot run.
    """

    def __init__(self, config: TrainConfig, *, stop_at: float = 0.0) -> None:
        if config.rollout.reset_every > 1:
            raise ConfigError(
                f"rollout.reset_every is {config.rollout.reset_every}; specialists play their level from its start in "
                "every update: set it to 1"
            )
        check_memory(config, 1)
        count_compile_seconds()
        self._config = config
        self._stop_at = stop_at
        self._mesh = data_mesh(jax.local_devices()[:1])
        self._env = make_environment(config)
        policy = make_policy(config.policy, self._env.action_distribution.head_sizes)
        curriculum = make_curriculum(config, self._env, policy, self._mesh)
        self._learner = LearnerCore(config, self._env, policy, self._mesh)
        self._rollout = RolloutCore(
            config,
            Players(self._env, policy, curriculum),
            self._mesh,
            groups=range(config.rollout.num_groups),
            division=self._learner.division,
        )
        self._network = NetworkPolicy(policy, self._env.action_distribution)

    def compile(self, level: Level, start: Arrays | None) -> float:
        """Plays, learns and evaluates once, so that clocks of specialists hold no compilation; s it took."""
        began = time.monotonic()
        self._learner.start(start)
        state = replicate(level, self._mesh)
        for update in range(2):  # what the second is given lies where the first left it
            self._update(state, update)
        self._evaluate(level, 0)
        return time.monotonic() - began

    def train(
        self,
        level: Level,
        start: Arrays | None,
        *,
        on_update: Callable[[int, Mapping[str, float]], None] = lambda number, metrics: None,
    ) -> Specialist:
        """A specialist for `level` ([1, ...] on every field).

        start: parameters as `starting_point` gives them; None: from the seed. on_update: called with the number of
        updates done and the metrics of the last.
        """
        compiled_before = compile_seconds()
        self._learner.start(start)
        state = replicate(level, self._mesh)
        training = evaluation = 0.0
        skipped = 0

        def evaluated(update: int) -> Point:
            nonlocal evaluation
            began = time.monotonic()
            point = self._evaluate(level, update)
            evaluation += time.monotonic() - began
            return point

        points = [evaluated(0)]
        update = 0
        while not self._is_over(update, training) and not self._is_good(points[-1]):
            began = time.monotonic()
            metrics = self._update(state, update)
            training += time.monotonic() - began
            update += 1
            skipped += int(metrics["learner/skipped_steps"])
            on_update(update, metrics)
            if update % self._config.evaluation.every == 0 or self._is_over(update, training):
                points.append(evaluated(update))
        return Specialist(
            points=tuple(points),
            params=local_values(self._learner.released),
            training_seconds=training,
            evaluation_seconds=evaluation,
            compile_seconds=compile_seconds() - compiled_before,
            skipped_steps=skipped,
        )

    def _update(self, state: Any, number: int) -> dict[str, float]:
        batch, _, sums, _ = self._rollout.play(self._learner.params, state, number)
        metrics = self._learner.learn(*batch, env_steps=self._env_steps(number))
        return training_metrics(
            local_values(sums),
            local_values(metrics),
            frame_skip=self._config.env.frame_skip,
            sources=self._config.curriculum_class.sources,
        )

    def _evaluate(self, level: Level, update: int) -> Point:
        """Levels, attempts and keys are the same every time, so that evaluations are paired."""
        player = Player(self._network, jax.device_put(local_values(self._learner.released)))
        key, attempts = prng.key(EVALUATION_STREAM), self._config.evaluation.attempts_of(1)
        rates = evaluate(self._env, player, level, attempts=attempts, key=key)
        return Point(
            updates=update, env_steps=self._env_steps(update), solved=rates.total.solved, attempts=rates.attempts
        )

    def _is_over(self, update: int, training_seconds: float) -> bool:
        return is_over(self._config.run, env_steps=self._env_steps(update), training_seconds=training_seconds)

    def _env_steps(self, num_updates: int) -> int:
        """Played in so many updates."""
        return num_updates * self._config.rollout.steps_per_update

    def _is_good(self, point: Point) -> bool:
        return bool(self._stop_at) and point.rate >= self._stop_at
