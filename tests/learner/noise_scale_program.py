"""Noise scale of a problem in which it is known, on one device and on three; prints the metrics of each as JSON.

    JAX_NUM_CPU_DEVICES=3 python tests/learner/noise_scale_program.py

The policy has one parameter b, the value of every state, and acts uniformly. Every step ends an episode, with a reward
r from N(1, 3^2), so that the target of the value is r. The gradient of a sample is value_coefficient (b - r), with
b = 0: mean -1 c, variance 9 c^2, noise scale 9 samples.
"""

from __future__ import annotations

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from jax2d.scene import Capacity
from kinetix_dist.benchmarks.synthetic_batch import ACTIONS, synthetic_static_obs, synthetic_trajectory
from kinetix_dist.env.observations import OBSERVATIONS
from kinetix_dist.learner.config import PpoConfig
from kinetix_dist.learner.division import Division
from kinetix_dist.learner.sharding import data_mesh, replicate, spread_worlds
from kinetix_dist.learner.update import make_update
from kinetix_dist.messages import StaticInput

CAPACITY = Capacity(polygons=2, circles=1, joints=1, thrusters=1)
STEPS, WORLDS = 8, 4096
# Parameters stay where they are, so that all 256 minibatches measure the same.
PPO = PpoConfig(epochs=1, minibatches=256, virtual_shards=4, learning_rate=1e-12, value_clip=False, noise_scale=True)


class OneValue(nn.Module):
    """Value b of every state; uniform actions."""

    @nn.compact
    def __call__(self, obs):
        b = self.param("b", nn.initializers.zeros, ())
        num_samples = jax.tree.leaves(obs)[0].shape[0]
        logits = tuple(jnp.zeros((num_samples, size)) for size in ACTIONS.head_sizes)
        return logits, jnp.broadcast_to(b, (num_samples,))


def make_policy() -> nn.Module:
    return OneValue()


def measured(num_devices: int) -> dict[str, float]:
    mesh = data_mesh(jax.devices()[:num_devices])
    static = StaticInput(obs=synthetic_static_obs(WORLDS, CAPACITY))
    trajectory = synthetic_trajectory(STEPS, WORLDS, CAPACITY)
    rewards = np.random.default_rng(0).normal(1.0, 3.0, (STEPS, WORLDS)).astype(np.float32)
    ends, values = np.ones((STEPS, WORLDS), bool), np.zeros((STEPS, WORLDS), np.float32)
    trajectory = dataclasses.replace(trajectory, values=values, rewards=rewards, done_after=ends)
    observation, policy = OBSERVATIONS["entity"], make_policy()
    obs = observation.join(static.obs, jax.tree.map(lambda x: x[0], trajectory.dynamic_obs))
    state = replicate(PPO.initial_state(policy.init(jax.random.key(0), obs), jax.random.key(1)), mesh)
    division = Division(PPO.virtual_shards, num_devices)
    arguments = (
        spread_worlds(static, mesh, division),
        spread_worlds(trajectory, mesh, division, axis=1),
        spread_worlds(np.zeros(WORLDS, np.float32), mesh, division),
    )
    _, metrics = make_update(policy, observation, ACTIONS, PPO, mesh)(state, *arguments)
    return {name: float(value) for name, value in metrics.items()}


if __name__ == "__main__":
    print(json.dumps({number: measured(number) for number in (1, len(jax.devices()))}))
