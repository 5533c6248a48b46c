"""Action spaces by name, `EnvConfig.action_space`. One file each, with the same few methods (`space.py`)."""

from __future__ import annotations

from kinetix_dist.env.action_spaces.continuous import Continuous
from kinetix_dist.env.action_spaces.discrete import Discrete
from kinetix_dist.env.action_spaces.multi_discrete import MultiDiscrete
from kinetix_dist.env.action_spaces.space import ActionDistribution, ActionSpace
from kinetix_dist.registry import Registry

__all__ = ["ACTION_SPACES", "ActionDistribution", "ActionSpace", "Continuous", "Discrete", "MultiDiscrete"]

ACTION_SPACES: Registry[ActionSpace] = Registry("action space")
for _space in (MultiDiscrete(), Continuous(), Discrete()):
    ACTION_SPACES.register(_space.name, _space)
