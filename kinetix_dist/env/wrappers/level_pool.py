"""Levels that episodes are drawn from: prepared once, one of them chosen by number whenever an episode starts."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.level.level import Level


class LevelPool:
    """Prepared levels of an environment."""

    def __init__(self, env: Environment, levels: Level) -> None:
        """levels: [N, ...] on every field. Raises ValueError for what the environment does not take."""
        self.env = env
        self.num_levels: int = levels.angle.shape[0]
        self._prepared = env.prepare(levels)

    def select(self, numbers: Array) -> PreparedLevels:
        """Prepared levels of these numbers, [W] int32."""
        prepared = self._prepared
        # Packed arrays have worlds last, all others first.
        packed = {
            name: jax.tree.map(lambda x: jnp.take(x, numbers, axis=-1), getattr(prepared, name))
            for name in ("packed_scene", "initial_packed_state")
        }
        others = {name: getattr(prepared, name) for name in vars(prepared) if name not in packed}
        return PreparedLevels(**packed, **jax.tree.map(lambda x: jnp.take(x, numbers, axis=0), others))

    def start(self, numbers: Array) -> tuple[PreparedLevels, EnvState, Any]:
        """(levels, first state, first observation as `Environment.observe` takes it) of episodes on levels [W]."""
        prepared = self.select(numbers)
        return prepared, *self.env.reset(prepared)
