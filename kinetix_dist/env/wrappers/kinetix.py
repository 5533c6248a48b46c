"""The few names of the public Kinetix package that its random-rollout example uses, over this environment.

    from kinetix_dist.env.wrappers.kinetix import (ActionType, EnvParams, ObservationType, StaticEnvParams,
        make_kinetix_env, make_render_pixels, make_reset_fn_sample_kinetix_level)

Signatures are those of kinetix-env 3.0.2: `reset(key, env_params, override_reset_state)` and
`step(key, state, action, env_params, override_reset_state)` with one `done`. A given `override_reset_state`, a level or
a state, is where the episode starts that begins in this call; it holds for this call alone.

What differs: observations are those of this package (a picture is uint8 [125, 125, 3] with row 0 at the top), and slots
is that of a size: `StaticEnvParams()` is size L (12 circles, joints and thrusters there).
"""

from __future__ import annotations

import enum
import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from jax2d.draw import draw
from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.wrappers.gymnax_env import GymnaxEnv, GymnaxState
from kinetix_dist.level.generator import generate_level
from kinetix_dist.level.generator_config import generator
from kinetix_dist.level.level import SIZES, WORLD_SIZE_M, Level
from kinetix_dist.level.walls import empty_level


class ObservationType(enum.Enum):
    """Values are names of `env.observations`."""

    PIXELS = "pixels"
    SYMBOLIC_FLAT = "flat"
    SYMBOLIC_ENTITY = "entity"


class ActionType(enum.Enum):
    """Values are names of `env.action_spaces`."""

    CONTINUOUS = "continuous"
    DISCRETE = "discrete"
    MULTI_DISCRETE = "multi_discrete"


@struct.dataclass
class EnvParams:
    """Parameters of an episode."""

    max_timesteps: int = struct.field(pytree_node=False, default=256)
    dense_reward_scale: float = struct.field(pytree_node=False, default=0.1)  # 0: the reward "sparse"

    @property
    def max_steps_in_episode(self) -> int:
        return self.max_timesteps


@struct.dataclass
class StaticEnvParams:
    """Compiled-in parameters. Numbers of shapes, joints and thrusters have to be those of a size."""

    num_polygons: int = struct.field(pytree_node=False, default=SIZES["l"].polygons)
    num_circles: int = struct.field(pytree_node=False, default=SIZES["l"].circles)
    num_joints: int = struct.field(pytree_node=False, default=SIZES["l"].joints)
    num_thrusters: int = struct.field(pytree_node=False, default=SIZES["l"].thrusters)
    frame_skip: int = struct.field(pytree_node=False, default=1)

    @property
    def size(self) -> str:
        """Raises ValueError where there is no such size."""
        capacity = (self.num_polygons, self.num_circles, self.num_joints, self.num_thrusters)
        capacities = {name: (size.polygons, size.circles, size.joints, size.thrusters) for name, size in SIZES.items()}
        for name, known in capacities.items():
            if capacity == known:
                return name
        raise ValueError(
            f"StaticEnvParams has {capacity} polygons, circles, joints and thrusters; sizes are "
            + ", ".join(f"{name} {known}" for name, known in capacities.items())
        )


@struct.dataclass
class KinetixState(GymnaxState):
    """State of one world, with the level as it was drawn, for pictures."""

    source: Level


class KinetixEnv(GymnaxEnv):
    """One world whose episodes start where `reset_fn` says, unless a call says otherwise."""

    def __init__(
        self,
        config: EnvConfig,
        reset_fn: Callable[[Array], Level] | None,
        static_params: StaticEnvParams,
        *,
        auto_reset: bool = True,
    ) -> None:
        some = jax.tree.map(lambda x: jnp.asarray(x)[None], empty_level(config.capacity))
        super().__init__(config, some)
        self._reset_fn = reset_fn
        self._auto_reset = auto_reset
        self.static_env_params = static_params

    @property
    def default_params(self) -> Any:
        config = self.env.config
        scale = config.dense_reward_scale if config.reward == "dense" else 0.0
        return EnvParams(max_timesteps=config.max_steps, dense_reward_scale=scale)

    @functools.partial(jax.jit, static_argnames=("self",))
    def reset(
        self, key: Array, env_params: Any = None, override_reset_state: Level | KinetixState | None = None
    ) -> tuple[Any, KinetixState]:
        """(observation, state). Raises ValueError without a level where the environment has no `reset_fn`."""
        self._check(env_params)
        return self._start(key, override_reset_state)

    @functools.partial(jax.jit, static_argnames=("self",))
    def step(
        self,
        key: Array,
        state: Any,
        action: Any,
        env_params: Any = None,
        override_reset_state: Level | KinetixState | None = None,
    ) -> tuple[Any, Any, Array, Array, dict]:
        """(observation, state, reward, done, info). Where done, observation and state are those of a new episode.

        Without `auto_reset` they are the last ones of the episode, and the caller calls `reset`.
        """
        params = self._check(env_params)
        step_key, reset_key = prng.split(key)
        last_obs, next_state, reward, terminated, info = self.step_env(step_key, state, action, params)
        truncated = self.is_truncated(next_state, params)
        done = terminated | truncated
        info |= {"terminated": terminated, "truncated": truncated, "final_observation": last_obs}
        if not self._auto_reset:
            return last_obs, next_state, reward, done, info
        first = self._start(reset_key, override_reset_state)
        obs, next_state = jax.tree.map(lambda new, old: jnp.where(done, new, old), first, (last_obs, next_state))
        return obs, next_state, reward, done, info

    def reset_env(self, key: Array, params: Any) -> tuple[Any, KinetixState]:
        return self._start(key, None)

    def _start(self, key: Array, given: Level | KinetixState | None) -> tuple[Any, KinetixState]:
        if isinstance(given, KinetixState):
            return self._joined(given.level, self.env.obs_of_start(given.level, given.episode)), given
        if given is not None:
            source = given
        elif self._reset_fn is not None:
            source = self._reset_fn(key)
        else:
            raise ValueError("this environment has no reset_fn; give a level or a state as override_reset_state")
        level = self.env.prepare(jax.tree.map(lambda x: jnp.asarray(x)[None], source))
        obs, state = self.first(level, *self.env.reset(level))
        return obs, KinetixState(**vars(state), source=source)

    def _check(self, params: Any) -> Any:
        if params is not None and params != self.default_params:
            raise ValueError(f"this environment was made for {self.default_params}; make one for {params}")
        return self.default_params


def make_kinetix_env(
    action_type: ActionType,
    observation_type: ObservationType,
    reset_fn: Callable[[Array], Level] | None,
    env_params: EnvParams | None = None,
    static_env_params: StaticEnvParams | None = None,
    auto_reset: bool = True,
) -> KinetixEnv:
    """An environment that draws a level for every episode.

    reset_fn: None, where each `reset` and `step` is given a level. auto_reset: a `step` that ends an episode begins the
    next one; without it `step` needs no level.
    """
    params, static = env_params or EnvParams(), static_env_params or StaticEnvParams()
    scale = params.dense_reward_scale
    reward: dict[str, Any] = {"dense_reward_scale": scale} if scale else {"reward": "sparse"}
    config = EnvConfig(
        size=static.size,
        frame_skip=static.frame_skip,
        max_steps=params.max_timesteps,
        action_space=action_type.value,
        observation=observation_type.value,
        **reward,
    )
    return KinetixEnv(config, reset_fn, static, auto_reset=auto_reset)


def make_reset_fn_sample_kinetix_level(
    env_params: EnvParams, static_env_params: StaticEnvParams
) -> Callable[[Array], Level]:
    """A function of a key that draws a random level, from the distribution of the public package."""
    del env_params
    return functools.partial(generate_level, capacity=SIZES[static_env_params.size], config=generator("kinetix"))


def make_render_pixels(
    env_params: EnvParams, static_env_params: StaticEnvParams
) -> Callable[[KinetixState], np.ndarray]:
    """A function that draws a state: float32 [500, 500, 3], x first and then y upwards."""
    del env_params, static_env_params

    def render(state: KinetixState) -> np.ndarray:
        level = jax.tree.map(np.asarray, state.source)
        position, angle = (np.asarray(part) for part in state.poses)
        image = draw(
            level.scene,
            SimpleNamespace(position=position, angle=angle),
            level.shape_role,
            view=(0.0, 0.0, WORLD_SIZE_M, WORLD_SIZE_M),
        )
        return image[::-1].transpose(1, 0, 2).astype(np.float32)

    return render
