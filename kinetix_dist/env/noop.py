"""What happens on a level when nobody acts: levels that solve themselves teach nothing and are filtered out."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.actions import noop_actions
from kinetix_dist.env.environment import Environment
from kinetix_dist.level.level import Level

NOOP_STEPS = 64  # environment steps; the published generator looks as far ahead


def noop_solved(env: Environment, levels: Level, num_steps: int = NOOP_STEPS) -> Array:
    """[W] bool: the first episode of each level is solved without any action, within `num_steps` environment steps.

    levels: a batch, [W, ...] on every field. Pure; jit it with `env` and `num_steps` fixed.
    """
    prepared = env.prepare(levels)
    env_state, _ = env.reset(prepared)
    num_worlds = env_state.num_steps.shape[0]
    actions = noop_actions(env.action_space, num_worlds)

    def advance(carry: tuple, _: None) -> tuple[tuple, None]:
        env_state, is_solved, is_over = carry
        env_state, _, _, done, info = env.step(prepared, env_state, actions)
        return (env_state, is_solved | (info.solved & ~is_over), is_over | done), None

    nothing = jnp.zeros_like(env_state.num_steps, dtype=bool)
    (_, is_solved, _), _ = jax.lax.scan(advance, (env_state, nothing, nothing), None, length=num_steps)
    return is_solved
