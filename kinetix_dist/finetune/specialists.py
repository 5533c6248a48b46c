"""Training on one level after another, or on several at once, with one set of compiled programs.

    Specialists(config)                         builds the programs: rollout, update, evaluation
    .compile(levels, starts)                    compiles them, on one level each
    .train(levels, starts, seeds=...)           trains afresh on these; nothing is compiled again

Levels and seeds are the state of a curriculum, an argument of the program that plays, and so are parameters: programs
depend on the size of levels and on how many there are alone. Several at once play in one program, and learn one after
another.
"""

from __future__ import annotations

import dataclasses
import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from kinetix_dist.checkpoint.manifest import MANIFEST_NAME
from kinetix_dist.config import ConfigError, TrainConfig
from kinetix_dist.errors import UserError
from kinetix_dist.finetune.joint_rollout import JointRollout, SeededLevels
from kinetix_dist.learner.sharding import data_mesh, local_values, replicate
from kinetix_dist.learner.state import LearnerState
from kinetix_dist.level.level import Level
from kinetix_dist.models.policy import make_policy
from kinetix_dist.program_cache import compile_seconds, count_compile_seconds
from kinetix_dist.runtime import (
    LearnerCore,
    Players,
    is_over,
    make_curriculum,
    make_environment,
    training_metrics,
)
from kinetix_dist.stored_specialists import FROM_SCRATCH
from kinetix_dist.trained_policy import Trained, checkpoint_at, newest_checkpoint_of


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
            # The checkpoint that this policy was trained from in its turn.
            "start_from": checkpoint.config.get("run", {}).get("start_from", ""),
        },
    )


def like_policy(config: TrainConfig, trained: Trained) -> TrainConfig:
    """`config` with the network and the environment of a policy, and the modules that its parts come from."""
    theirs = trained.config
    plugins = tuple(dict.fromkeys((*config.run.plugins, *theirs.plugins)))
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
    """Trains on single levels, `together` of them at a time in one program, on one device.

    A specialist ends as a run does, after `run.total_env_steps` or `run.max_seconds`, or at the first evaluation
    whose solve rate is `stop_at` (0: none). Evaluations are every `evaluation.every` updates and at the end.
    Raises ValueError, DeviceMemoryError for what cannot run.
    """

    def __init__(self, config: TrainConfig, *, stop_at: float = 0.0, together: int = 1) -> None:
        if config.rollout.reset_every > 1:
            raise ConfigError(
                f"rollout.reset_every is {config.rollout.reset_every}; specialists play their level from its start in "
                "every update: set it to 1"
            )
        count_compile_seconds()
        self._config = config
        self._stop_at = stop_at
        self._mesh = data_mesh(jax.local_devices()[:1])
        env = make_environment(config)
        policy = make_policy(config.policy, env.action_distribution.head_sizes)
        curriculum = make_curriculum(config, env, policy, self._mesh)
        self._learner = LearnerCore(config, env, policy, self._mesh)
        self._rollout = JointRollout(config, Players(env, policy, curriculum), self._mesh, together)

    def compile(self, levels: Level, starts: Sequence[Arrays | None]) -> float:
        """Plays, learns and evaluates once, so that clocks of specialists hold no compilation; s it took."""
        began = time.monotonic()
        states, seeded = self._begun(levels, starts, None)
        for update in range(2):  # what the second is given lies where the first left it
            self._update(states, seeded, update, range(len(states)))
        self._evaluate(states, seeded.levels, 0)
        return time.monotonic() - began

    def train(
        self,
        levels: Level,
        starts: Sequence[Arrays | None],
        *,
        seeds: Sequence[int] | None = None,
        on_update: Callable[[int, Mapping[str, float]], None] = lambda number, metrics: None,
        on_end: Callable[[int, Specialist], None] = lambda number, specialist: None,
    ) -> list[Specialist]:
        """A specialist for each of `levels` ([together, ...] on every field).

        starts: parameters of each as `starting_point` gives them; None: from its seed. seeds: of each; None: that of
        the configuration. on_update: called with the number of updates done and the metrics of what was played in the
        last. on_end: called with the number of each specialist when it ends. Seconds are shared out equally.
        """
        states, seeded = self._begun(levels, starts, seeds)
        levels = seeded.levels
        compiled_before = compile_seconds()
        count = len(states)
        training = evaluation = 0.0
        skipped = [0] * count

        def evaluated(update: int) -> list[Point]:
            nonlocal evaluation
            began = time.monotonic()
            points = self._evaluate(states, levels, update)
            evaluation += (time.monotonic() - began) / count
            return points

        ended: dict[int, Specialist] = {}
        curves = [[point] for point in evaluated(0)]
        update = 0
        while True:
            all_end = self._is_over(update, training)
            for i in range(count):
                if i in ended or not (all_end or self._is_good(curves[i][-1])):
                    continue
                ended[i] = Specialist(
                    points=tuple(curves[i]),
                    params=local_values(states[i].released),
                    training_seconds=training,
                    evaluation_seconds=evaluation,
                    compile_seconds=compile_seconds() - compiled_before,
                    skipped_steps=skipped[i],
                )
                on_end(i, ended[i])
            learning = [i for i in range(count) if i not in ended]
            if not learning:
                return [ended[i] for i in range(count)]
            began = time.monotonic()
            metrics, own_skipped = self._update(states, seeded, update, learning)
            training += (time.monotonic() - began) / count
            update += 1
            for i, steps in zip(learning, own_skipped, strict=True):
                skipped[i] += steps
            on_update(update, metrics)
            if update % self._config.evaluation.every == 0 or self._is_over(update, training):
                points = evaluated(update)
                for i in learning:
                    curves[i].append(points[i])

    def _begun(
        self, levels: Level, starts: Sequence[Arrays | None], seeds: Sequence[int] | None
    ) -> tuple[list[LearnerState], SeededLevels]:
        count = self._rollout.num_specialists
        seeds = [self._config.run.seed] * count if seeds is None else seeds
        if not len(starts) == len(seeds) == count:
            raise ValueError(f"{len(starts)} starts and {len(seeds)} seeds for {count} specialists")
        states = [self._learner.started(start, seed=seed) for start, seed in zip(starts, seeds, strict=True)]
        return states, replicate(SeededLevels(levels, np.array(seeds, np.uint32)), self._mesh)

    def _update(
        self, states: list[LearnerState], seeded: SeededLevels, number: int, learning: Sequence[int]
    ) -> tuple[dict[str, float], list[int]]:
        """(metrics of what all played, gradient steps left out by each that is `learning`), and the next states."""
        batches, sums = self._rollout.play([state.params for state in states], seeded, number)
        skipped = []
        for i in learning:
            states[i], metrics = self._learner.learned(states[i], *batches[i], env_steps=self._env_steps(number))
            skipped.append(metrics["skipped_steps"])
        played = training_metrics(
            local_values(sums),
            {},
            frame_skip=self._config.env.frame_skip,
            sources=self._config.curriculum_class.sources,
        )
        return played, [int(steps) for steps in skipped]

    def _evaluate(self, states: Sequence[LearnerState], levels: Level, update: int) -> list[Point]:
        attempts = self._config.evaluation.attempts_of(1)
        found = self._rollout.evaluate([state.released for state in states], levels, attempts)
        return [
            Point(updates=update, env_steps=self._env_steps(update), solved=solved, attempts=attempts)
            for solved, attempts in found
        ]

    def _is_over(self, update: int, training_seconds: float) -> bool:
        return is_over(self._config.run, env_steps=self._env_steps(update), training_seconds=training_seconds)

    def _env_steps(self, num_updates: int) -> int:
        """Played by a specialist in so many updates."""
        return num_updates * self._config.rollout.steps_per_update

    def _is_good(self, point: Point) -> bool:
        return bool(self._stop_at) and point.rate >= self._stop_at
