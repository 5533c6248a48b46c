"""Reward of the paper: the sparse one, and in each step kappa (d_t - d_{t+1}), d the distance of green and blue.

(Paper, section "RL Environment Specification".) kappa is `dense_reward_scale`, per metre.
"""

from __future__ import annotations

from jax2d.scene import Array
from kinetix_dist.env.rewards.reward import Step
from kinetix_dist.env.rewards.sparse import SparseReward


class DenseReward(SparseReward):
    """Sparse reward plus the way that green came closer to blue."""

    uses_dense_scale = True

    def reward(self, step: Step) -> Array:
        return super().reward(step) + step.dense_scale * (step.distance_before - step.distance_after)
