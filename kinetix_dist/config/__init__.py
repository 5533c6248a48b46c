"""Configuration of a training run.

setting.py (below)  declaration of a field and its limits
sections.py         sections of the run itself; others stand beside their component
phases.py           settings that change at a step
refresh_times.py    updates at which the curriculum is refreshed
train_config.py     `TrainConfig`, all sections; its hash
checks.py           checks between sections
plain.py            to and from plain values
stored.py           configs of runs and checkpoints, with today's names
"""

from kinetix_dist.config.phases import PhaseConfig, read_phases
from kinetix_dist.config.plain import build, differing, flat, to_dict
from kinetix_dist.config.sections import (
    EvaluationConfig,
    ImitationConfig,
    LimitsConfig,
    RecordingConfig,
    RolloutConfig,
    RunConfig,
)
from kinetix_dist.config.stored import (
    curriculum_from_dict,
    from_dict,
    from_dict_as_recipe,
    from_dict_for_playing,
    has_same_numbers,
    with_phases,
)
from kinetix_dist.config.train_config import StoredConfig, TrainConfig, differences, numbers_of
from kinetix_dist.setting import ConfigError, check_finite

__all__ = [
    "ConfigError",
    "EvaluationConfig",
    "ImitationConfig",
    "LimitsConfig",
    "PhaseConfig",
    "RecordingConfig",
    "RolloutConfig",
    "RunConfig",
    "StoredConfig",
    "TrainConfig",
    "build",
    "check_finite",
    "curriculum_from_dict",
    "differences",
    "differing",
    "flat",
    "from_dict",
    "from_dict_as_recipe",
    "from_dict_for_playing",
    "has_same_numbers",
    "numbers_of",
    "read_phases",
    "to_dict",
    "with_phases",
]
