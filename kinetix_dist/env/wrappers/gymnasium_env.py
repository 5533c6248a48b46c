"""The environment as gymnasium has it: `KinetixVectorEnv`, many worlds at once, and `KinetixEnv`, one.

    envs = gymnasium.make_vec("kinetix-dist/S-v0", num_envs=64)        see kinetix_dist/gymnasium_envs.py
    envs = KinetixVectorEnv(EnvConfig(size="s", observation="flat"), levels, num_envs=64)
    obs, infos = envs.reset(seed=0)                                    each world draws one of the levels
    obs, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())

Arrays are numpy and the caller's own. An episode that is solved or has failed is terminated, one that ran out of steps
truncated. Worlds of a vector restart in the same step on the level they have (`AutoresetMode.SAME_STEP`): `obs` is the
first observation of the next episode, `infos["final_obs"]` the last one of that which ended, `infos["final_info"]` what
became of it. With `autoreset=False` (`AutoresetMode.DISABLED`) the caller resets worlds that ended, and no others.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from jax2d.draw import draw
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.level_pool import RANDOM, LevelPool, levels_of
from kinetix_dist.env.records import StepInfo
from kinetix_dist.level.level import Level

INFO_FIELDS = ("solved", "failed", "timed_out", "unstable", "episode_return", "episode_length")
METADATA = {"render_modes": ["rgb_array"], "render_fps": 30}


class KinetixVectorEnv(VectorEnv):
    """Worlds of one size. Episodes start on one of `levels`, drawn at `reset`, and restart on the same."""

    metadata: dict[str, Any] = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self, config: EnvConfig, levels: Level, *, num_envs: int, render_mode: str | None = None, autoreset: bool = True
    ) -> None:
        """levels: [N, ...] on every field. autoreset False: a world that ended is reset before the next step."""
        if not autoreset:
            self.metadata = self.metadata | {"autoreset_mode": AutoresetMode.DISABLED}
        _check_render_mode(render_mode)
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; it must be 1 or more")
        self.env = Environment(config)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_observation_space = observation_space(self.env)
        self.single_action_space = action_space(self.env.action_space)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._levels = jax.tree.map(np.asarray, levels)
        self._pool = LevelPool(self.env, levels)
        self._start = jax.jit(self._pool.start)
        self._observe = jax.jit(self.env.observe)
        self._advance = jax.jit(self.env.transition)
        self._restart = jax.jit(self.env.restart)
        self._select = jax.jit(self.env.select)
        self.level_numbers = np.zeros(num_envs, np.int32)  # of each world, [num_envs]
        self._has_ended = np.zeros(num_envs, bool)  # worlds that wait for `reset`; none where they restart
        self._episode: tuple[Any, Any, Any] | None = None  # (prepared levels, state, observation before `observe`)

    @property
    def num_levels(self) -> int:
        return self._pool.num_levels

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Observations of all worlds, of which some or all are at the start of an episode.

        options: {"levels": numbers [num_envs] of the levels to play}, by default drawn at random; {"reset_mask": bool
        [num_envs]} starts episodes in these worlds alone, and others stay where they are.
        """
        super().reset(seed=seed)
        options = options or {}
        mask = _reset_mask(options.get("reset_mask"), self.num_envs)
        if self._episode is None and not mask.all():
            raise gymnasium.error.ResetNeeded("call reset() for all worlds before reset() for some of them")
        numbers = options.get("levels")
        if numbers is None:
            numbers = self.level_numbers.copy()
            numbers[mask] = self.np_random.integers(self._pool.num_levels, size=np.count_nonzero(mask))
        chosen = _level_numbers(numbers, self.num_envs, self._pool.num_levels)
        self.level_numbers = np.where(mask, chosen, self.level_numbers)
        prepared, state, obs = self._start(jnp.asarray(self.level_numbers))
        if self._episode is not None and not mask.all():
            state, obs = self._select(prepared, jnp.asarray(mask), (state, obs), self._episode[1:])
        self._episode = prepared, state, obs
        self._has_ended = self._has_ended & ~mask
        return self._to_numpy(prepared, obs), {}

    def step(self, actions: Any) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """actions: of `action_space`. Raises ValueError for others, `ResetNeeded` while a world waits for `reset`."""
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        if self._has_ended.any():
            raise gymnasium.error.ResetNeeded(
                f"episodes of worlds {np.flatnonzero(self._has_ended).tolist()} have ended; "
                'call reset(options={"reset_mask": mask}) for them before step()'
            )
        prepared, state, _ = self._episode
        actions = np.asarray(actions)
        self.env.action_space.check(actions, self.num_envs)  # before the cast, which would cut 0.9 to 0
        state, obs, reward, done, info = self._advance(
            prepared, state, jnp.asarray(actions, self.env.action_space.dtype)
        )
        done, info = np.asarray(done), _info_arrays(info)
        infos: dict[str, Any] = {}
        if done.any():
            if self.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP:
                last = self._to_numpy(prepared, obs)
                for world in np.flatnonzero(done).tolist():
                    ended = {name: info[name][world] for name in INFO_FIELDS}
                    final = {"final_obs": one_of(last, world), "final_info": ended}
                    infos = self._add_info(infos, final, world)
                state, obs = self._restart(prepared, jnp.asarray(done), state, obs)
            else:
                infos = info
                self._has_ended = done
        self._episode = prepared, state, obs
        truncations = info["timed_out"].copy()
        return self._to_numpy(prepared, obs), np.array(reward), done & ~truncations, truncations, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """A picture of every world, uint8 [rows, columns, 3]."""
        if self.render_mode is None or self._episode is None:
            return None
        state = self._episode[1]
        position, angle, *_ = jax.tree.map(np.asarray, self.env.engine.bodies(state.packed_state))
        pictures = []
        for world, number in enumerate(self.level_numbers):
            level = jax.tree.map(lambda x: x[number], self._levels)  # noqa: B023 (called at once)
            pictures.append(
                draw(level.scene, SimpleNamespace(position=position[world], angle=angle[world]), level.shape_role)
            )
        return tuple(pictures)

    def _to_numpy(self, prepared: Any, obs: Any) -> Any:
        return as_dict(jax.tree.map(_as_numpy, self._observe(prepared, obs)))


class KinetixEnv(gymnasium.Env):
    """One world. An episode that ended needs a `reset`, which draws the next level."""

    metadata: dict[str, Any] = METADATA

    def __init__(self, config: EnvConfig, levels: Level, *, render_mode: str | None = None) -> None:
        self._envs = KinetixVectorEnv(config, levels, num_envs=1, render_mode=render_mode, autoreset=False)
        self.render_mode = render_mode
        self.observation_space = self._envs.single_observation_space
        self.action_space = self._envs.single_action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """options: {"level": number of the level to play}, by default drawn at random."""
        super().reset(seed=seed)
        number = (options or {}).get("level", self.np_random.integers(self._envs.num_levels))
        obs, _ = self._envs.reset(options={"levels": [number]})
        return one_of(obs, 0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, infos = self._envs.step(np.asarray(action)[None])
        info = {name: value[0] for name, value in infos.items()}
        return one_of(obs, 0), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray | None:
        pictures = self._envs.render()
        return None if pictures is None else pictures[0]


def make(
    *,
    size: str,
    levels: str | Level = RANDOM,
    num_levels: int = 256,
    observation: str = "entity",
    action_space: str = "multi_discrete",
    render_mode: str | None = None,
) -> KinetixEnv:
    """One world, for `gymnasium.make("kinetix-dist/M-v0")`. levels: as `kinetix_dist.make` takes them."""
    config = EnvConfig(size=size, observation=observation, action_space=action_space)
    return KinetixEnv(config, levels_of(config, levels, num_levels=num_levels, seed=0)[0], render_mode=render_mode)


def make_vec(
    *,
    size: str,
    num_envs: int = 1,
    levels: str | Level = RANDOM,
    num_levels: int = 256,
    observation: str = "entity",
    action_space: str = "multi_discrete",
    render_mode: str | None = None,
) -> KinetixVectorEnv:
    """Many worlds, for `gymnasium.make_vec("kinetix-dist/M-v0")`. levels: as `kinetix_dist.make` takes them."""
    config = EnvConfig(size=size, observation=observation, action_space=action_space)
    pool, _ = levels_of(config, levels, num_levels=num_levels, seed=0)
    return KinetixVectorEnv(config, pool, num_envs=num_envs, render_mode=render_mode)


def observation_space(env: Environment) -> spaces.Space:
    """Space of one world: a Box, or a Dict with the fields of an `EntityObs`."""
    obs = env.observation_space
    if dataclasses.is_dataclass(obs):
        return spaces.Dict({name: _space_of(part, env) for name, part in vars(obs).items()})
    return _space_of(obs, env)


def action_space(space: ActionSpace) -> spaces.Space:
    """Space of one world."""
    if not space.is_integer:
        return spaces.Box(np.asarray(space.low, np.float32), np.asarray(space.high, np.float32), dtype=np.float32)
    choices = np.asarray(space.high, np.int64) + 1
    return spaces.Discrete(int(choices[0])) if space.is_flat else spaces.MultiDiscrete(choices)


def as_dict(obs: Any) -> Any:
    """The fields of a dataclass by name; an array as it is."""
    return vars(obs) if dataclasses.is_dataclass(obs) else obs


def one_of(obs: Any, world: int) -> Any:
    """Space of one world from that of a batch, [W, ...] on every array."""
    return {name: part[world] for name, part in obs.items()} if isinstance(obs, dict) else obs[world]


def _space_of(part: jax.ShapeDtypeStruct, env: Environment) -> spaces.Space:
    if part.dtype == np.bool_:
        return spaces.MultiBinary(part.shape)
    if part.dtype == np.float32:
        return spaces.Box(-np.inf, np.inf, part.shape, np.float32)
    highest = 255 if part.dtype == np.uint8 else env.capacity.shapes - 1  # of a picture, or the number of a shape
    return spaces.Box(0, highest, part.shape, part.dtype)


def _as_numpy(x: Any) -> np.ndarray:
    return np.array(x, np.int8 if x.dtype == np.bool_ else None)  # as MultiBinary has it


def _info_arrays(info: StepInfo) -> dict[str, np.ndarray]:
    return {name: np.array(getattr(info, name)) for name in INFO_FIELDS}


def _reset_mask(mask: np.ndarray | None, num_envs: int) -> np.ndarray:
    """[num_envs] bool, by default all of them."""
    if mask is None:
        return np.ones(num_envs, bool)
    found = np.asarray(mask)
    if found.dtype != np.bool_ or found.shape != (num_envs,) or not found.any():
        raise ValueError(f"reset_mask is {mask!r}; give {num_envs} booleans, True in one world or more")
    return found


def _level_numbers(numbers: Sequence[int] | np.ndarray, num_envs: int, num_levels: int) -> np.ndarray:
    found = np.asarray(numbers)
    is_integer = np.issubdtype(found.dtype, np.integer)
    if not is_integer or found.shape != (num_envs,) or not ((found >= 0) & (found < num_levels)).all():
        raise ValueError(f"levels are {numbers!r}; give {num_envs} numbers from 0 to {num_levels - 1}, one a world")
    return found.astype(np.int32)


def _check_render_mode(mode: str | None) -> None:
    if mode not in (None, *METADATA["render_modes"]):
        raise ValueError(f"render_mode is {mode!r}; it can be None or {' or '.join(METADATA['render_modes'])}")
