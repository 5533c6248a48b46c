"""Compiled programs of a run: the settings they depend on, and compiling in threads while the process does other work.

A program that is traced from `settings_of_programs(config)` can depend on nothing else of the config: it is the same
for two runs of equal settings, and is cached for the next one. A sweep, a run that goes on and the parts of a run in
local mode compile once.

XLA compiles a program on one or two cores and without Python's lock, so that several take as long as the slowest where
there are cores enough. Where there are two, three programs at a time took longer than one after the other.
"""

from __future__ import annotations

import contextvars
import dataclasses
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future

from kinetix_dist.config import EvaluationConfig, ImitationConfig, RecordingConfig, RunConfig, TrainConfig
from kinetix_dist.learner.plasticity import PlasticityConfig
from kinetix_dist.telemetry.curriculum_log import CurriculumLogConfig

MAX_CACHED = 8  # of each kind, those used last


def settings_of_programs(config: TrainConfig) -> TrainConfig:
    """The config without how long, where, on how many processes, and how often it is saved, evaluated and logged."""
    return dataclasses.replace(
        config,
        curriculum_log=CurriculumLogConfig(),
        evaluation=EvaluationConfig(),
        imitation=ImitationConfig(),
        plasticity=PlasticityConfig(),
        recording=RecordingConfig(),
        run=RunConfig(seed=config.run.seed, total_env_steps=1),
    )


THREAD = "compile-ahead"  # name of the threads
MIN_CORES = 8


def has_cores() -> bool:
    """Says whether this process has cores enough to compile several programs at a time."""
    return len(os.sched_getaffinity(0)) >= MIN_CORES


class Ahead:
    """Jobs that compile. A later call of the same jit function finds the program in memory, given the same
    shapes and shardings, which neither traces nor compiles it again."""

    def __init__(self) -> None:
        self._jobs: list[Future[None]] = []

    def begin(self, job: Callable[[], None]) -> None:
        """Runs `job` in a thread of its own. A job may begin others. Threads do not keep the process from ending: only
        for processes that are ended from outside, since the end of Python does not wait for the compiler in them."""
        future: Future[None] = Future()
        self._jobs.append(future)
        context = contextvars.copy_context()

        def run() -> None:
            try:
                context.run(job)
            except BaseException as error:
                future.set_exception(error)
            else:
                future.set_result(None)

        threading.Thread(target=run, name=THREAD, daemon=True).start()

    def wait(self) -> None:
        """Until all are done; raises what one of them raised. Cheap where none was begun."""
        while self._jobs:
            self._jobs[0].result()  # a job that it began is behind it by now
            del self._jobs[0]
