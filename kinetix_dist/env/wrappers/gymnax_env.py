"""The environment as gymnax has it: one world, pure functions, a key and parameters in every call.

    env = GymnaxEnv(EnvConfig(size="s", observation="flat"), levels)
    params = env.default_params
    obs, state = env.reset(key, params)                                            draws one of the levels
    obs, state, reward, terminated, truncated, info = env.step(key, state, action, params)

An episode that ended restarts in the same step on another level (gymnax's own `step`); the physics itself needs no
key. `jax.vmap` over keys and states plays many worlds, and the engine steps them as one batch.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from gymnax.environments import environment, spaces

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.level_pool import LevelPool
from kinetix_dist.env.records import EnvState, PreparedLevels
from kinetix_dist.level.level import Level


@struct.dataclass
class GymnaxParams(environment.EnvParams):
    """Parameters that may change without another environment."""

    max_steps_in_episode: int = 256  # environment steps; no more than EnvConfig.max_steps


@struct.dataclass
class GymnaxState:
    """State of one world; arrays have a world axis of 1."""

    level: PreparedLevels
    episode: EnvState
    poses: tuple[Array, Array]  # position [n, 2] m and angle [n] rad of all shapes
    time: Array  # [] int32, environment steps taken
    timed_out: Array  # [] bool


class GymnaxEnv(environment.Environment):
    """One world whose episodes start on one of `levels`."""

    def __init__(self, config: EnvConfig, levels: Level) -> None:
        """levels: [N, ...] on every field."""
        self.env = Environment(config)
        self._pool = LevelPool(self.env, levels)

    @property
    def default_params(self) -> GymnaxParams:
        return GymnaxParams(max_steps_in_episode=self.env.config.max_steps)

    @property
    def name(self) -> str:
        return f"kinetix-dist-{self.env.config.size}"

    @property
    def num_actions(self) -> int:
        """Choices of a discrete space, else numbers of an action."""
        space = self.env.action_space
        return int(space.high[0]) + 1 if space.is_flat else space.num_dimensions

    def reset_env(self, key: Array, params: GymnaxParams) -> tuple[Any, GymnaxState]:
        number = prng.randint(key, (1,), 0, self._pool.num_levels)
        return self.first(*self._pool.start(number))

    def first(self, level: PreparedLevels, episode: EnvState, obs: Any) -> tuple[Any, GymnaxState]:
        """First observation and state of an episode of one world, from what `Environment.reset` gave."""
        poses = self._poses(level, episode)
        state = GymnaxState(level=level, episode=episode, poses=poses, time=jnp.int32(0), timed_out=jnp.bool_(False))
        return self._joined(level, obs), state

    def _poses(self, level: PreparedLevels, episode: EnvState) -> tuple[Array, Array]:
        position, angle, *_ = self.env.engine.bodies(episode.packed_state)
        return position[0], angle[0]

    def step_env(
        self, key: Array, state: GymnaxState, action: Array, params: GymnaxParams
    ) -> tuple[Any, GymnaxState, Array, Array, dict[str, Array]]:
        actions = jnp.asarray(action)[None]
        self.env.action_space.check(actions, 1)  # before the cast, which would cut 0.9 to 0
        actions = actions.astype(self.env.action_space.dtype)
        episode, obs, reward, done, info = self.env.transition(state.level, state.episode, actions)
        timed_out = info.timed_out[0]
        poses = self._poses(state.level, episode)
        state = dataclasses.replace(state, episode=episode, poses=poses, time=episode.num_steps[0], timed_out=timed_out)
        infos = {name: value[0] for name, value in vars(info).items()}
        infos["discount"] = 1.0 - (done[0] & ~timed_out).astype(jnp.float32)
        return self._joined(state.level, obs), state, reward[0], done[0] & ~timed_out, infos

    def is_truncated(self, state: GymnaxState, params: GymnaxParams) -> Array:
        return state.timed_out | (state.time >= params.max_steps_in_episode)

    def observation_space(self, params: object) -> spaces.Space:
        obs = self.env.observation_space
        if dataclasses.is_dataclass(obs):
            return spaces.Dict({name: _space_of(part, self.env) for name, part in vars(obs).items()})
        return _space_of(obs, self.env)

    def action_space(self, params: object = None) -> spaces.Space:
        return action_space(self.env.action_space)

    def _joined(self, level: PreparedLevels, obs: Any) -> Any:
        return jax.tree.map(lambda x: x[0], self.env.observe(level, obs))


class MultiDiscreteSpace(spaces.Space):
    """A choice for each of several dimensions; gymnax has no such space."""

    def __init__(self, choices: tuple[int, ...]) -> None:
        self.choices = choices
        self.shape = (len(choices),)
        self.dtype = jnp.int32

    def sample(self, key: Array) -> Array:
        return prng.randint(key, self.shape, 0, jnp.asarray(self.choices))

    def contains(self, x: Array) -> Array:
        return jnp.all((x >= 0) & (x < jnp.asarray(self.choices)))


def action_space(space: ActionSpace) -> spaces.Space:
    """Space of one world."""
    if not space.is_integer:
        return spaces.Box(jnp.float32(space.low), jnp.float32(space.high), (space.num_dimensions,), jnp.float32)
    choices = tuple(int(high) + 1 for high in space.high)
    return spaces.Discrete(choices[0]) if space.is_flat else MultiDiscreteSpace(choices)


def _space_of(part: jax.ShapeDtypeStruct, env: Environment) -> spaces.Box:
    low, high = (-jnp.inf, jnp.inf) if part.dtype == jnp.float32 else (0, env.capacity.shapes - 1)
    if part.dtype in (jnp.uint8, jnp.bool_):
        high = 255 if part.dtype == jnp.uint8 else 1
    return spaces.Box(low, high, part.shape, part.dtype)
