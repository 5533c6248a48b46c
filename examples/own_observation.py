"""An observation of your own: where shapes are and how they move, seen from the green one.

    python examples/own_observation.py                      trains for seconds on the CPU
    PYTHONPATH=examples kinetix-dist train --recipe quickstart --run.plugins own_observation \\
        --env.observation from_green --policy.network flat

An observation is three pure functions of a batch of worlds. `static` runs once a level, `dynamic` every step, and
trajectories store what it gives; `join` makes the input of the policy of both.
"""

from __future__ import annotations

import sys

import jax
import jax.numpy as jnp

from kinetix_dist.cli.main import main
from kinetix_dist.env.observations import OBSERVATIONS, VECTOR, Moving, Observation
from kinetix_dist.level.level import Level, Role


class FromGreen(Observation):
    """Position and velocity relative to the green shape, and the role: 5 numbers a shape."""

    gives = VECTOR  # one vector a world, which the network "flat" takes

    def static(self, levels: Level) -> jax.Array:
        return jnp.where(levels.scene.shapes.active, levels.shape_role, -1)

    def dynamic(self, moving: Moving) -> jax.Array:
        return jnp.concatenate([moving.position, moving.velocity], axis=-1)

    def join(self, static: jax.Array, dynamic: jax.Array) -> jax.Array:
        # Axes before the last two may be worlds, or steps and worlds.
        is_green = (static == Role.GREEN)[..., None]
        green = jnp.sum(jnp.where(is_green, dynamic, 0.0), axis=-2, keepdims=True)
        rows = jnp.concatenate([dynamic - green, static[..., None].astype(jnp.float32)], axis=-1)
        rows = jnp.where(static[..., None] >= 0, rows, 0.0)  # slots without a shape
        return rows.reshape(*rows.shape[:-2], -1)


if __name__ == "__main__":
    options = ["--run.plugins", "own_observation", "--env.observation", "from_green", "--policy.network", "flat"]
    raise SystemExit(main(["train", "--recipe", "tiny", *options, *sys.argv[1:]]))

# A run imports this file as a plugin, in each of its processes: the name is known from then on.
OBSERVATIONS.register("from_green", FromGreen())
