"""Wraps environments by TorchRL and checks their specs. Run by test_torchrl.py with an interpreter that has torchrl."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import torch  # pyrefly: ignore[missing-import]
from torchrl.envs import GymEnv, GymWrapper  # pyrefly: ignore[missing-import]
from torchrl.envs.utils import check_env_specs  # pyrefly: ignore[missing-import]

from kinetix_dist import gymnasium_envs
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.wrappers.gymnasium_env import KinetixVectorEnv
from kinetix_dist.level.sets import load_level_set

ID = gymnasium_envs.IDS["s"]
MAX_STEPS = 8
OPTIONS: dict[str, Any] = {"levels": "designed_s", "max_steps": MAX_STEPS}


def check_single(**settings: Any) -> None:
    env = GymWrapper(gymnasium.make(ID, **OPTIONS, **settings))
    check_env_specs(env)
    assert env.rollout(4).batch_size == (4,)


def check_vector(array: str, **settings: Any) -> None:
    """Check that the next observation of an ended episode is its last one, not the first of the next episode.

    array: name of the part of the observation that is compared.
    """
    env = GymWrapper(gymnasium.make_vec(ID, num_envs=2, **OPTIONS, **settings))
    check_env_specs(env)
    rollout = env.rollout(3 * MAX_STEPS, break_when_any_done=False)
    assert rollout.batch_size == (2, 3 * MAX_STEPS)
    ended = rollout["next", "done"][:, :-1, 0]
    assert ended.any()
    last, first = rollout["next", array][:, :-1], rollout[array][:, 1:]
    differs = (last != first).flatten(2).any(-1)
    torch.testing.assert_close(differs, ended)


def check_vector_that_its_caller_resets() -> None:
    levels = load_level_set("designed_s")[0]
    envs = KinetixVectorEnv(EnvConfig(observation="flat", max_steps=MAX_STEPS), levels, num_envs=2, autoreset=False)
    env = GymWrapper(envs)
    check_env_specs(env)
    assert env.rollout(2 * MAX_STEPS, break_when_any_done=False).batch_size == (2, 2 * MAX_STEPS)


def main() -> None:
    for observation, array in (("flat", "observation"), ("entity", "polygons")):
        check_single(observation=observation)
        check_vector(array, observation=observation)
    for action_space in ("discrete", "continuous"):
        check_single(observation="flat", action_space=action_space)
    check_vector_that_its_caller_resets()
    check_env_specs(GymEnv(ID, **OPTIONS))
    sys.stdout.write("all specs hold\n")


if __name__ == "__main__":
    main()
