"""Robust Prioritized Level Replay (Jiang et al. 2021, "Replay-Guided Adversarial Environment Design").

PLR that learns from levels of its buffer alone: fresh levels are played to be scored, and give no gradient. Its
guarantee is that of a game between policy and curriculum: at an equilibrium the policy is one of minimax regret.

The worlds of fresh levels cost playing time and no learning time: batches of the learner hold the others only. As in
`plr.py`, the buffer is empty in the first update (the first two in the split placement): what its worlds repeat then,
and the policy learns from, are fresh levels after all.
"""

from __future__ import annotations

from kinetix_dist.curator.buffer_share import num_from_buffer
from kinetix_dist.curator.config import CurriculumConfig
from kinetix_dist.curator.plr import Plr


class RobustPlr(Plr):
    """Its worlds of the buffer are the first ones of each group."""

    @classmethod
    def num_trained(cls, config: CurriculumConfig, worlds_per_group: int) -> int:
        return num_from_buffer(config, worlds_per_group)
