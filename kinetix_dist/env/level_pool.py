"""Levels that episodes are drawn from: prepared once, one of them chosen by number whenever an episode starts."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from jax2d import after_fork
from jax2d.scene import Array
from jax2d.settings import Settings
from kinetix_dist import prng
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.level.generator import generate_filtered
from kinetix_dist.level.generator_config import GeneratorConfig
from kinetix_dist.level.level import Level
from kinetix_dist.level.sets import load_level_set
from kinetix_dist.level.simulation import noop_solved

RANDOM = "random"  # name of levels that are drawn from a seed
NUM_RANDOM = 256  # of them, by default


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


def levels_of(
    config: EnvConfig, levels: str | Level, *, num_levels: int | None = None, seed: int | None = None
) -> tuple[Level, list[str]]:
    """A batch of levels in arrays of the size of `config`, and their names.

    Args:
      levels: "random" draws `num_levels` (256) levels from `seed` (0) and leaves out levels that solve themselves.
        Another name is a level set or a file, see `load_level_set`. A batch is used unchanged.

    Raises:
      ValueError: for `num_levels` or `seed` with levels that are not drawn; as `load_level_set` does.
    """
    after_fork.check()
    is_drawn = isinstance(levels, str) and levels == RANDOM
    for name, value in (("num_levels", num_levels), ("seed", seed)):
        if value is not None and not is_drawn:
            raise ValueError(f"{name} is {value}, but only levels={RANDOM!r} are drawn; leave {name} out")
    if not isinstance(levels, str):
        return levels, [f"level_{number}" for number in range(levels.angle.shape[0])]
    if not is_drawn:
        return load_level_set(levels, config.size)
    num_levels, seed = NUM_RANDOM if num_levels is None else num_levels, seed or 0
    if num_levels < 1:
        raise ValueError(f"num_levels is {num_levels}; it must be 1 or more")
    drawn = _random_levels(prng.key(seed), num_levels, config.size, config.physics)
    return drawn, [f"{RANDOM}_{number}" for number in range(num_levels)]


def _random_levels(key: Array, num_levels: int, size: str, physics: Settings) -> Level:
    return generate_filtered(
        key, num_levels, size, GeneratorConfig(), lambda levels: noop_solved(levels, settings=physics)
    )
