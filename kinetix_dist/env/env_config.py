"""What an environment is: `EnvConfig`, section `env` of a run's configuration."""

from __future__ import annotations

import dataclasses

import numpy as np

from jax2d.scene import Capacity
from jax2d.settings import Settings, preset
from jax2d.whole_numbers import whole_number
from kinetix_dist.env.action_spaces import ACTION_SPACES
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.level.level import SIZES


@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvConfig:
    """Defaults are those of the paper."""

    size: str = "s"  # "s", "m" or "l", see `level.SIZES`
    physics: Settings = preset("standard")  # how a physics step is solved, all numbers of it
    frame_skip: int = 2  # physics steps of 1/60 s in one environment step
    max_steps: int = 256  # environment steps after which an episode times out
    dense_reward_scale: float = 0.1  # kappa, reward for each metre that green comes closer to blue
    failure_penalty: float = 1.0  # reward for touching red is minus this
    action_space: str = "multi_discrete"  # or "continuous" or "discrete", see `env.action_spaces`
    observation: str = "entity"  # or "flat" or "pixels", see `env.observations`
    effect_groups: int = 0  # groups of worlds with engines of their own, see `env.stepper`; 0: one full engine for all

    def __post_init__(self) -> None:
        if self.size not in SIZES:
            raise ValueError(f"EnvConfig.size is {self.size!r}; sizes are {', '.join(SIZES)}")
        for name, known in (("action_space", ACTION_SPACES), ("observation", OBSERVATIONS)):
            if getattr(self, name) not in known:
                raise ValueError(f"EnvConfig.{name} is {getattr(self, name)!r}; choose one of {', '.join(known)}")
        for name in ("frame_skip", "max_steps"):
            if whole_number(f"EnvConfig.{name}", getattr(self, name)) < 1:
                raise ValueError(f"EnvConfig.{name} is {getattr(self, name)}; it must be 1 or more")
        if self.physics.solver_batch_size > 1:
            raise ValueError(
                f"EnvConfig.physics has solver_batch_size {self.physics.solver_batch_size}; the kernel, which steps "
                "environments, solves one contact after another: use 1"
            )
        if whole_number("EnvConfig.effect_groups", self.effect_groups) < 0:
            raise ValueError(f"EnvConfig.effect_groups is {self.effect_groups}; it must be 0 or more")
        for name in ("dense_reward_scale", "failure_penalty"):
            if not 0 <= getattr(self, name) <= float(np.finfo(np.float32).max):
                raise ValueError(f"EnvConfig.{name} is {getattr(self, name)}; it must be 0 or more, and a float32")

    @property
    def capacity(self) -> Capacity:
        return SIZES[self.size]
