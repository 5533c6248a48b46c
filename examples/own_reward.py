"""A reward of your own: the goal, less what motors and thrusters do for it.

    python examples/own_reward.py                           trains for seconds on the CPU
    PYTHONPATH=examples kinetix-dist train --recipe quickstart --run.plugins own_reward --env.reward goal_less_effort

A reward is a pure function of one environment step of a batch of worlds. `static` runs once a level, `reward` every
step.
"""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp

from kinetix_dist.cli.main import main
from kinetix_dist.env.rewards import REWARDS, SparseReward, Step
from kinetix_dist.level.level import Level, obeying_motors

PRICE = 0.002  # of a motor or thruster that runs at full power for a step; an episode has 256 of them


class GoalLessEffort(SparseReward):
    """+1 for blue, -failure_penalty for red, and in each step PRICE times the effort."""

    def static(self, levels: Level) -> tuple[jax.Array, jax.Array]:
        # Slots without a motor or thruster, and motors that run by themselves, cost nothing.
        return obeying_motors(levels), levels.scene.thrusters.active

    def reward(self, step: Step) -> jax.Array:
        has_motor, has_thruster = step.level
        motors = jnp.where(has_motor, jnp.abs(step.controls.motor), 0.0).sum(axis=-1)
        thrusters = jnp.where(has_thruster, step.controls.thruster, 0.0).sum(axis=-1)
        return super().reward(step) - PRICE * (motors + thrusters)


if __name__ == "__main__":
    options = ["--run.plugins", "own_reward", "--env.reward", "goal_less_effort"]
    raise SystemExit(main(["train", "--recipe", "tiny", *options, *sys.argv[1:]]))

# A run imports this file as a plugin, in each of its processes: the name is known from then on.
REWARDS.register("goal_less_effort", GoalLessEffort())
