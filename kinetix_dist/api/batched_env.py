"""Many worlds as one environment of pure functions: `make`, `BatchedEnv`, `draw`.

    env = make("m", num_envs=1024, levels="designed_m")
    observation, state = env.reset(key)
    observation, state, reward, done, info = env.step(key, state, action)

Signatures follow gymnax, batched over worlds. A world whose episode ended starts the next one in the same step, on a
level drawn from the pool: `reward`, `done` and `info` are of the episode that ended, `observation` is the first of the
next. Both functions work inside `jit` and `scan` and are compiled when they are called outside.
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jax2d import after_fork
from jax2d.draw import draw as draw_world
from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.level_pool import RANDOM, LevelPool, levels_of
from kinetix_dist.env.records import EnvState, PreparedLevels, StepInfo
from kinetix_dist.level.level import Level

RESTARTS_AT_ONCE = 16  # a sixteenth of the worlds restart together: episodes seldom end in more of them


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchState:
    """State of all worlds of a `BatchedEnv`."""

    level_number: Array  # [W] int32, index of each world's level in `BatchedEnv.levels`
    levels: PreparedLevels
    episode: EnvState


class BatchedEnv:
    """`num_envs` worlds of one size whose episodes start on levels of a pool."""

    def __init__(self, config: EnvConfig, levels: Level, *, num_envs: int, level_names: list[str]) -> None:
        """levels: [N, ...] on every field, in arrays of the size of `config`; level_names: of each."""
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; it must be 1 or more")
        self.environment = Environment(config)
        self.num_envs = num_envs
        self.levels: Level = jax.tree.map(np.asarray, levels)
        self.level_names = level_names
        self._pool = LevelPool(self.environment, levels)
        self._jit_reset = jax.jit(self._reset)
        self._jit_step = jax.jit(self._step)

    @property
    def config(self) -> EnvConfig:
        """Size, physics, rewards, time limit, observation and action space."""
        return self.environment.config

    @property
    def action_space(self) -> ActionSpace:
        """Type and range of actions; `action_space.sample(key, num_envs)` draws some."""
        return self.environment.action_space

    @property
    def observation_space(self) -> Any:
        """Shapes and types of an observation of one world, each a `jax.ShapeDtypeStruct`."""
        return self.environment.observation_space

    def reset(self, key: Array) -> tuple[Any, BatchState]:
        """(observation [W, ...], state) at the start of an episode in every world. Consumes the key."""
        after_fork.check()
        return self._jit_reset(key)

    def step(self, key: Array, state: BatchState, action: Array) -> tuple[Any, BatchState, Array, Array, StepInfo]:
        """(observation, state, reward [W] float32, done [W] bool, info) of one step in every world.

        The key draws the levels of the episodes that start now, and is consumed. Raises ValueError for actions of a
        wrong shape or type and, outside of `jit`, for numbers out of range.
        """
        after_fork.check()
        self.action_space.check(action, self.num_envs)
        return self._jit_step(key, state, action)

    def _reset(self, key: Array) -> tuple[Any, BatchState]:
        numbers = self._draw(key)
        levels, episode, obs = self._pool.start(numbers)
        return self.environment.observe(levels, obs), BatchState(level_number=numbers, levels=levels, episode=episode)

    def _step(self, key: Array, state: BatchState, action: Array) -> tuple[Any, BatchState, Array, Array, StepInfo]:
        episode, obs, reward, done, info = self.environment.transition(state.levels, state.episode, jnp.asarray(action))
        numbers = jnp.where(done, self._draw(key), state.level_number)
        levels, episode, obs = self._restart(numbers, done, (state.levels, episode, obs))
        observation = self.environment.observe(levels, obs)
        return observation, BatchState(level_number=numbers, levels=levels, episode=episode), reward, done, info

    def _draw(self, key: Array) -> Array:
        return prng.randint(key, (self.num_envs,), 0, self._pool.num_levels)

    def _restart(
        self, numbers: Array, done: Array, worlds: tuple[PreparedLevels, EnvState, Any]
    ) -> tuple[PreparedLevels, EnvState, Any]:
        """Worlds in which episodes on levels `numbers` [W] have started where `done` [W].

        A few worlds are replaced at a time: what a step costs follows from how many episodes end, not from all worlds.
        """
        at_once = -(-self.num_envs // RESTARTS_AT_ONCE)

        def replace(now: tuple[Array, Any]) -> tuple[Array, Any]:
            waiting, worlds = now
            (index,) = jnp.nonzero(waiting, size=at_once, fill_value=self.num_envs)  # none beyond the last world
            started = self._pool.start(numbers[jnp.minimum(index, self.num_envs - 1)])
            return waiting.at[index].set(False, mode="drop"), _put(worlds, index, started)

        return jax.lax.while_loop(lambda now: now[0].any(), replace, (done, worlds))[1]


def make(
    size: str | EnvConfig = "m",
    *,
    num_envs: int = 1,
    levels: str | Level = RANDOM,
    num_levels: int | None = None,
    seed: int | None = None,
) -> BatchedEnv:
    """An environment of `num_envs` worlds that step together.

    Raises ValueError for `num_levels` or `seed` with levels that are not drawn.

    Args:
      size: "s", "m" or "l"; or an `EnvConfig`, which also chooses physics, observation, action space and rewards.
      levels: levels on which episodes start. "random" draws `num_levels` (256) of them from `seed` (0); "designed_m"
        and the like are level sets (`kinetix-dist levels list`); a path names a level file or a directory of them; or a
        batch of levels.
    """
    config = size if isinstance(size, EnvConfig) else EnvConfig(size=size)
    chosen, names = levels_of(config, levels, num_levels=num_levels, seed=seed)
    return BatchedEnv(config, chosen, num_envs=num_envs, level_names=names)


def draw(env: BatchedEnv, state: BatchState, world: int = 0, *, pixels_per_metre: float = 100.0) -> np.ndarray:
    """Picture of one world, uint8 [rows, columns, 3]. Green is to touch blue, and not red."""
    after_fork.check()
    if not 0 <= world < env.num_envs:
        raise ValueError(f"world is {world}; there are worlds 0 to {env.num_envs - 1}")
    position, angle, *_ = env.environment.engine.bodies(state.episode.packed_state)
    level = jax.tree.map(lambda x: x[int(state.level_number[world])], env.levels)
    pose = SimpleNamespace(position=np.asarray(position[world]), angle=np.asarray(angle[world]))
    return draw_world(level.scene, pose, level.shape_role, pixels_per_metre=pixels_per_metre)


def _put(
    worlds: tuple[PreparedLevels, EnvState, Any], index: Array, started: tuple[PreparedLevels, EnvState, Any]
) -> tuple[PreparedLevels, EnvState, Any]:
    """`worlds` with `started` at `index`; an index beyond the last world is dropped."""
    levels, episode, obs = worlds
    new_levels, new_episode, new_obs = started
    # Packed arrays have worlds last, all others first.
    packed = {"packed_scene", "initial_packed_state", "packed_state"}

    def put(old: Any, new: Any, name: str = "") -> Any:
        where = (..., index) if name in packed else (index,)
        return jax.tree.map(lambda a, b: a.at[where].set(b, mode="drop"), old, new)

    def put_record(old: Any, new: Any) -> Any:
        changed = {name: put(getattr(old, name), getattr(new, name), name) for name in vars(old)}
        return dataclasses.replace(old, **changed)

    return put_record(levels, new_levels), put_record(episode, new_episode), put(obs, new_obs)
