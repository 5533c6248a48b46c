"""Potential-based shaping: the sparse reward plus F = gamma Phi(s') - Phi(s), with Phi = -kappa d.

d is the distance of green and blue, kappa is `dense_reward_scale`, gamma is `shaping_discount`. Policies that are
optimal for the sparse reward are optimal for this one, too (Ng, Harada and Russell, 1999): discounted by gamma, the F
of an episode add up to -Phi(s_0), whatever the policy does. That needs Phi = 0 in the state that ends an episode,
however it ends (Grzes, 2017), and the discount of the learner. The dense reward has gamma = 1 and no such end: an
episode that ends near to blue without touching it has gained by it.
"""

from __future__ import annotations

import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.rewards.reward import Step
from kinetix_dist.env.rewards.sparse import SparseReward


class ShapedReward(SparseReward):
    """Sparse reward plus the discounted change of a potential."""

    uses_dense_scale = True
    uses_discount = True

    def reward(self, step: Step) -> Array:
        before = -step.dense_scale * step.distance_before
        after = jnp.where(step.outcome.done, 0.0, -step.dense_scale * step.distance_after)
        return super().reward(step) + step.discount * after - before
