"""The rule of `level/simulation.py` with an environment's engines, frame skip and time limit."""

from __future__ import annotations

from typing import Any

from jax2d.scene import Array, Controls, Touching
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.level import Level
from kinetix_dist.level.simulation import NOOP_STEPS, is_solved_without_actions


def noop_solved(env: Environment, levels: Level, num_steps: int = NOOP_STEPS) -> Array:
    """[W] bool: the first episode of each level is solved without any action, within `num_steps` environment steps.

    levels: a batch, [W, ...] on every field. Pure; jit it with `env` and `num_steps` fixed.
    """

    def step(scene: Any, state: Any, controls: Controls) -> tuple[Any, Touching]:
        return env.engine.step_packed(scene, state, controls, env.config.frame_skip)

    return is_solved_without_actions(levels, env.pack, step, min(num_steps, env.config.max_steps))
