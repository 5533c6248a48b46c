"""What compiled programs of a run may depend on, so that runs of one process share them.

A program that is traced from `settings_of_programs(config)` can depend on nothing else of the config: it is the same
for two runs of equal settings, and is kept for the next one. A sweep, a run that goes on and the parts of a run in
local mode compile once.
"""

from __future__ import annotations

import dataclasses

from kinetix_dist.config import EvaluationConfig, RecordingConfig, RunConfig, TrainConfig
from kinetix_dist.telemetry.curriculum_log import CurriculumLogConfig

MAX_KEPT = 8  # of each kind, those used last


def settings_of_programs(config: TrainConfig) -> TrainConfig:
    """The config without how long, where, on how many processes, and how often it is saved, evaluated and logged."""
    return dataclasses.replace(
        config,
        curriculum_log=CurriculumLogConfig(),
        evaluation=EvaluationConfig(),
        recording=RecordingConfig(),
        run=RunConfig(seed=config.run.seed, total_env_steps=1),
    )
