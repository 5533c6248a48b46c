"""Rewards by name, `EnvConfig.reward`. One file each, with one method (`reward.py`)."""

from __future__ import annotations

from kinetix_dist.env.rewards.dense import DenseReward
from kinetix_dist.env.rewards.reward import Bodies, Reward, Step
from kinetix_dist.env.rewards.shaped import ShapedReward
from kinetix_dist.env.rewards.sparse import SparseReward
from kinetix_dist.registry import Registry

__all__ = ["REWARDS", "Bodies", "DenseReward", "Reward", "ShapedReward", "SparseReward", "Step"]

REWARDS: Registry[Reward] = Registry("reward")
REWARDS.register("dense", DenseReward())
REWARDS.register("sparse", SparseReward())
REWARDS.register("shaped", ShapedReward())
