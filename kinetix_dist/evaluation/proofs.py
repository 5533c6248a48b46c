"""Replays proofs: does what a file claims happen in the environment?

On the CPU a proof solves its level in exactly the steps that it has, from the same state bit for bit. On another device
float32 rounds otherwise, and it counts that the level is solved before time is out; after the end of the proof nothing
is done.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jax2d.scene import stack_worlds
from kinetix_dist.env.environment import Environment
from kinetix_dist.evaluation.recordings import record_actions
from kinetix_dist.level.level import Level
from kinetix_dist.level.proof import Proof
from kinetix_dist.telemetry.recording import Rollout


def replay(env: Environment, levels: Sequence[Level], proofs: Sequence[Proof]) -> list[Rollout]:
    """One rollout of each level, by the actions of its proof. Levels are of the environment's size."""
    actions = np.array(env.action_space.noop_actions(len(proofs)))
    actions = np.tile(actions, (env.config.max_steps, 1, 1))
    for world, proof in enumerate(proofs):
        actions[: proof.num_steps, world] = proof.actions
    return record_actions(env, stack_worlds(list(levels)), actions, names=[proof.level for proof in proofs])


def fault_of_replay(proof: Proof, rollout: Rollout) -> str | None:
    """Fault of a proof when it is replayed, in words; None where it solves the level.

    It may take other steps than where the proof was made: processors and compilers round otherwise.
    """
    if rollout.solved:
        return None
    return (
        f"the proof claims to solve it in {proof.num_steps} steps; replayed, it is {rollout.outcome} after "
        f"{rollout.num_steps}"
    )
