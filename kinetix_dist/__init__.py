"""kinetix-dist: pretrains agents on 2D rigid-body worlds that the engine `jax2d` simulates.

import kinetix_dist as kd

env = kd.make("m", num_envs=1024)                                     random levels of size M
policy = kd.load_policy("generalist")
observation, state = env.reset(jax.random.key(0))
action, memory = policy(observation, jax.random.key(1))
observation, state, reward, done, info = env.step(jax.random.key(2), state, action)
image = kd.draw(env, state)

JAX is imported when the first of these names is used. Environments are registered with gymnasium if that was imported
before; `import kinetix_dist.gymnasium_envs` registers them in any order.
"""

import importlib
import sys
from typing import TYPE_CHECKING, Any

from kinetix_dist import installation

if TYPE_CHECKING:
    from kinetix_dist.api.batched_env import BatchedEnv, BatchState, draw, make
    from kinetix_dist.api.policy_function import PolicyFunction, load_policy
    from kinetix_dist.env.env_config import EnvConfig
    from kinetix_dist.level.level import Level
    from kinetix_dist.level.sets import load_level_set

__all__ = [
    "BatchState",
    "BatchedEnv",
    "EnvConfig",
    "Level",
    "PolicyFunction",
    "draw",
    "load_level_set",
    "load_policy",
    "make",
]

_MODULES = {
    "BatchState": "api.batched_env",
    "BatchedEnv": "api.batched_env",
    "EnvConfig": "env.env_config",
    "Level": "level.level",
    "PolicyFunction": "api.policy_function",
    "draw": "api.batched_env",
    "load_level_set": "level.sets",
    "load_policy": "api.policy_function",
    "make": "api.batched_env",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'kinetix_dist' has no attribute {name!r}")
    return getattr(importlib.import_module(f"kinetix_dist.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


installation.guard()
if "gymnasium" in sys.modules:
    from kinetix_dist import gymnasium_envs as gymnasium_envs
