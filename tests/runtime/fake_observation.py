"""An observation of a user: where shapes are and how they move, seen from the green one. Registered by import."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from kinetix_dist.env.observations import OBSERVATIONS, VECTOR, Moving, Observation
from kinetix_dist.level.level import Level, Role


class FromGreen(Observation):
    """5 n numbers a world; 16 n bytes a world and step are stored."""

    gives = VECTOR

    def static(self, levels: Level) -> jax.Array:
        return jnp.where(levels.scene.shapes.active, levels.shape_role, -1)

    def dynamic(self, moving: Moving) -> jax.Array:
        return jnp.concatenate([moving.position, moving.velocity], axis=-1)

    def join(self, static: jax.Array, dynamic: jax.Array) -> jax.Array:
        is_green = (static == Role.GREEN)[..., None]
        from_green = dynamic - jnp.sum(jnp.where(is_green, dynamic, 0.0), axis=-2, keepdims=True)
        numbers = jnp.concatenate([from_green, static[..., None].astype(jnp.float32)], axis=-1)
        numbers = jnp.where(static[..., None] >= 0, numbers, 0.0)
        return numbers.reshape(*numbers.shape[:-2], -1)


OBSERVATIONS.register("from_green", FromGreen())
