"""Small runs that several tests of the runtime use."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from kinetix_dist.checkpoint import load_checkpoint, newest_good
from kinetix_dist.config import EvaluationConfig, LimitsConfig, TrainConfig, to_dict
from kinetix_dist.recipes import recipe
from kinetix_dist.runtime.driver.controller import Controller, Roles
from kinetix_dist.runtime.driver.run_directory import RunDirectory
from kinetix_dist.telemetry.sinks import Evaluation


class QuietReporter:
    """Keeps metrics; calls `at_update(number)` after each."""

    def __init__(self, at_update: Callable[[int], None] = lambda number: None) -> None:
        self.rows: list[dict[str, float]] = []
        self._at_update = at_update

    def phase(self, name: str) -> None:
        pass

    def note(self, message: str) -> None:
        pass

    def metrics(self, num_updates: int, metrics: Mapping[str, float], seconds_left: float | None) -> None:
        self.rows.append({"update": num_updates, **metrics})
        self._at_update(num_updates)

    def evaluated(self, evaluation: Evaluation) -> None:
        pass


class NotingReporter(QuietReporter):
    """Stores rows and notes, too."""

    def __init__(self, at_update: Callable[[int], None] = lambda number: None) -> None:
        super().__init__(at_update)
        self.notes: list[str] = []

    def note(self, message: str) -> None:
        self.notes.append(message)


# s: a hang ends a test with the name of who hangs. Machines that are busy with other tests are slow.
LIMITS = LimitsConfig(
    start=180.0, recover=180.0, compile=120.0, update=60.0, curate=60.0, evaluate=60.0, record=60.0, save=60.0
)


def tiny_config(*, num_updates: int, **run: Any) -> TrainConfig:
    """The recipe `tiny` for `num_updates` updates."""
    config = recipe("tiny")
    run = {"total_env_steps": num_updates * config.rollout.steps_per_update, "limits": LIMITS, **run}
    return dataclasses.replace(
        config,
        evaluation=EvaluationConfig(sets=("s/kick",), min_attempts=4),
        run=dataclasses.replace(config.run, **run),
    )


def without_evaluator(config: TrainConfig) -> TrainConfig:
    """Evaluates and records before and after training alone."""
    return dataclasses.replace(
        config,
        evaluation=dataclasses.replace(config.evaluation, every=0),
        recording=dataclasses.replace(config.recording, every=0),
    )


def run_directory(path: Path, config: TrainConfig, *, resume: bool) -> RunDirectory:
    """Run directory as the command makes it: with the configuration in it."""
    run = RunDirectory.open_existing(path) if resume else RunDirectory.create(path, numbered=False)
    run.write_json(run.config_path, {"hash": config.hash, "config": to_dict(config)})
    return run


def run_updates(
    config: TrainConfig,
    path: Path,
    trainer: Any,
    curator: Any,
    *,
    reporter: QuietReporter | None = None,
    resume: bool = False,
) -> Controller:
    """Trains without evaluations to the configured end; a checkpoint is left there."""
    run = run_directory(path, config, resume=resume)
    try:
        controller = Controller(config, run, Roles(trainer=trainer, curator=curator), reporter or QuietReporter())
        controller.restore(resume=resume)
        controller.train()
        return controller
    finally:
        run.close()


def final_arrays(path: Path) -> dict[str, np.ndarray]:
    checkpoint, rejected = newest_good(path / "checkpoints")
    assert checkpoint is not None and not rejected
    return load_checkpoint(checkpoint.path).arrays


def assert_same_bits(ours: Mapping[str, np.ndarray], theirs: Mapping[str, np.ndarray]) -> None:
    assert ours.keys() == theirs.keys()
    for name in ours:
        np.testing.assert_array_equal(ours[name], theirs[name], err_msg=name)
