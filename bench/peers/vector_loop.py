"""The RL loop that Box2D and our worlds are timed in: a policy in numpy acts in a gymnasium vector environment.

numpy alone, so that it runs in the environment of any peer: `bench/rl_loop.py` has ours, `box2d_loop.py` Box2D's.
"""

from __future__ import annotations

import itertools
import time
from typing import Any

import numpy as np

LAYERS, UNITS = 5, 128  # of the policy, as the network of flat observations has in the paper


class Policy:
    """tanh layers with random weights: actions [W, n] in [-1, 1] from observations [W, m]."""

    def __init__(self, num_inputs: int, num_actions: int, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        sizes = [num_inputs, *[UNITS] * LAYERS, num_actions]
        pairs = itertools.pairwise(sizes)
        self.weights = [(rng.normal(size=(m, n)) / np.sqrt(m)).astype(np.float32) for m, n in pairs]

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        for weights in self.weights:
            obs = np.tanh(obs @ weights)
        return obs


def steps_per_second(envs: Any, num_steps: int, repeats: int) -> list[float]:
    """Environment steps per second of each repeat, after one that is not timed. envs: a gymnasium.vector.VectorEnv of
    flat observations and actions in a box."""
    obs, _ = envs.reset(seed=0)
    actions = envs.single_action_space
    policy = Policy(obs.shape[1], actions.shape[0])
    found = []
    for _ in range(repeats + 1):
        began = time.perf_counter()
        for _ in range(num_steps):
            obs, *_ = envs.step(np.clip(policy(obs), actions.low, actions.high))
        found.append(envs.num_envs * num_steps / (time.perf_counter() - began))
    return found[1:]
