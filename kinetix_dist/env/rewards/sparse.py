"""Reward of the goal alone: +1 for touching blue, -failure_penalty for touching red (1 in the paper)."""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.rewards.reward import Reward, Step


class SparseReward(Reward):
    """Reward in the last step of an episode only."""

    uses_dense_scale = False
    uses_discount = False

    def reward(self, step: Step) -> Array:
        return step.outcome.solved.astype(jnp.float32) - step.failure_penalty * step.outcome.failed
