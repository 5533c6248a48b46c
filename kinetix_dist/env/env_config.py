"""Section `env` of a run's configuration."""

from __future__ import annotations

import dataclasses

import numpy as np

from jax2d.scene import Capacity
from jax2d.settings import PRESETS, Settings, preset
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.env.rewards import REWARDS
from kinetix_dist.level.level import SIZES
from kinetix_dist.setting import ConfigError, check_settings, setting

FLOAT32_MAX = float(np.finfo(np.float32).max)


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Size, physics, episodes and rewards of an environment; defaults are those of the paper."""

    size: str = setting("s", choices=SIZES)  # "s", "m" or "l", see `level.SIZES`
    physics: Settings = preset("standard")  # how a physics step is solved, all numbers of it
    frame_skip: int = setting(2, minimum=1, maximum=1000)  # physics steps of 1/60 s in one environment step
    max_steps: int = setting(256, minimum=1, maximum=1_000_000)  # environment steps after which an episode times out
    reward: str = setting("dense", choices=REWARDS)  # or "sparse" or "shaped"
    dense_reward_scale: float = setting(0.1, minimum=0, maximum=FLOAT32_MAX)  # reward per metre of green towards blue
    shaping_discount: float = setting(0.995, above=0, maximum=1)  # gamma of the reward "shaped", that of the learner
    failure_penalty: float = setting(1.0, minimum=0, maximum=FLOAT32_MAX)  # reward for touching red is minus this
    action_space: str = setting("multi_discrete", choices=ACTION_SPACES)  # or "continuous" or "discrete"
    observation: str = setting("entity", choices=OBSERVATIONS)  # or "flat" or "pixels"

    def __post_init__(self) -> None:
        check_settings(self)
        if self.dense_reward_scale == 0:
            raise ConfigError("EnvConfig.dense_reward_scale is 0; choose reward 'sparse', which has no dense term")
        if self.physics.solver_batch_size > 1:
            raise ConfigError(
                f"EnvConfig.physics has solver_batch_size {self.physics.solver_batch_size}; the kernel, which steps "
                "environments, solves one contact after another: use 1"
            )

    @property
    def capacity(self) -> Capacity:
        return SIZES[self.size]


def describe(settings: Settings) -> str:
    """ "standard", or "standard with substeps 8": the preset that fewest fields differ from, the first of equals."""
    changed = {name: _differences(settings, known) for name, known in PRESETS.items()}
    name = min(["standard", *changed], key=lambda preset: len(changed[preset]))
    return f"{name} with {', '.join(changed[name])}" if changed[name] else name


def _differences(settings: Settings, known: Settings) -> list[str]:
    """Fields that differ, as "substeps 8"."""
    names = [field.name for field in dataclasses.fields(settings)]
    return [f"{name} {getattr(settings, name)}" for name in names if getattr(settings, name) != getattr(known, name)]
