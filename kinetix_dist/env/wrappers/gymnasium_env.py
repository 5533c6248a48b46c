"""The environment behind the interface of gymnasium: `KinetixVectorEnv`, many worlds, and `KinetixEnv`, one world.

    envs = gymnasium.make_vec("kinetix-dist/S-v0", num_envs=64)        see kinetix_dist/gymnasium_envs.py
    envs = KinetixVectorEnv(EnvConfig(size="s", observation="flat"), levels, num_envs=64)
    obs, infos = envs.reset(seed=0)                                    each world draws one of the levels
    obs, rewards, terminations, truncations, infos = envs.step(envs.action_space.sample())

Arrays are numpy and belong to the caller. A solved or failed episode is terminated, one that ran out of steps
truncated. By default a world restarts in the same step on its own level (`AutoresetMode.SAME_STEP`): `obs` is the first
observation of the next episode, `infos["final_obs"]` the last one of the ended episode, `infos["final_info"]` its
outcome. With `autoreset=AutoresetMode.NEXT_STEP` a world restarts in the next step, which ignores its action. With
`autoreset=False` (`AutoresetMode.DISABLED`) the caller resets ended worlds.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from jax2d import after_fork
from jax2d.draw import draw
from kinetix_dist.env.env_config import EnvConfig
from kinetix_dist.env.environment import Environment
from kinetix_dist.env.level_pool import RANDOM, LevelPool, levels_of
from kinetix_dist.env.records import StepInfo
from kinetix_dist.env.wrappers.gymnasium_spaces import action_space, as_dict, as_numpy, observation_space
from kinetix_dist.level.level import Level
from kinetix_dist.near_names import did_you_mean

INFO_FIELDS = ("solved", "failed", "timed_out", "unstable", "episode_return", "episode_length")
METADATA = {"render_modes": ["rgb_array"], "render_fps": 30}
VECTOR_OPTIONS = ("levels", "reset_mask")  # of `KinetixVectorEnv.reset`
OPTIONS = ("level",)  # of `KinetixEnv.reset`

# Spaces of one world for each configuration that this process or its parent has made.
_spaces: dict[EnvConfig, tuple[spaces.Space, spaces.Space]] = {}


class KinetixVectorEnv(VectorEnv):
    """Worlds of one size. Episodes start on one of `levels`, drawn at `reset`, and restart on the same."""

    metadata: dict[str, Any] = METADATA | {"autoreset_mode": AutoresetMode.SAME_STEP}

    def __init__(
        self,
        config: EnvConfig,
        levels: Level,
        *,
        num_envs: int,
        render_mode: str | None = None,
        autoreset: bool | AutoresetMode = True,
    ) -> None:
        """Prepare the levels.

        Args:
          levels: [N, ...] on every field.
          autoreset: True restarts a world in the step that ends its episode, False leaves that to the caller; or a mode
            of gymnasium.
        """
        self.autoreset_mode = _autoreset_mode(autoreset)
        self.metadata = self.metadata | {"autoreset_mode": self.autoreset_mode}
        _check_render_mode(render_mode)
        if num_envs < 1:
            raise ValueError(f"num_envs is {num_envs}; it must be 1 or more")
        self.env = Environment(config)
        self.num_envs = num_envs
        self.render_mode = render_mode
        self.single_observation_space = observation_space(self.env)
        self.single_action_space = action_space(self.env.action_space)
        _spaces[config] = self.single_observation_space, self.single_action_space
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
        self._has_ended = np.zeros(num_envs, bool)  # worlds that wait for a reset; always False with SAME_STEP
        self._episode: tuple[Any, Any, Any] | None = None  # (prepared levels, state, observation before `observe`)

    @property
    def num_levels(self) -> int:
        return self._pool.num_levels

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Return the observations of all worlds, of which some or all start an episode, and no infos.

        Args:
          options: "levels", numbers [num_envs] of the levels to play, which are drawn at random by default;
            "reset_mask", bool [num_envs], starts episodes in these worlds and leaves the others as they are.
        """
        after_fork.check()
        super().reset(seed=seed)
        chosen_options = _checked_options(options, VECTOR_OPTIONS)
        mask = _reset_mask(chosen_options.get("reset_mask"), self.num_envs)
        if self._episode is None and not mask.all():
            raise gymnasium.error.ResetNeeded("call reset() for all worlds before reset() for some of them")
        numbers = chosen_options.get("levels")
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
        """Step all worlds by actions of `action_space`.

        Raises:
          ValueError: for other actions.
          ResetNeeded: before the first `reset`, and with `autoreset=False` while a world waits for one.
        """
        after_fork.check()
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._has_ended.any():
            raise gymnasium.error.ResetNeeded(
                f"episodes of worlds {np.flatnonzero(self._has_ended).tolist()} have ended; "
                'call reset(options={"reset_mask": mask}) for them before step()'
            )
        prepared, state, _ = self._episode
        actions = np.asarray(actions)
        self.env.action_space.check(actions, self.num_envs)  # before the cast, which would cut 0.9 to 0
        actions = jnp.asarray(actions, self.env.action_space.dtype)
        state, obs, reward, done, info = self._advance(prepared, state, actions)
        rewards, done, info = np.array(reward), np.array(done), _info_arrays(info)
        infos: dict[str, Any] = {}
        if self._has_ended.any():  # NEXT_STEP: their last step ended an episode, and this one begins the next
            state, obs = self._restart(prepared, jnp.asarray(self._has_ended), state, obs)
            for array in (rewards, done, *info.values()):
                array[self._has_ended] = 0
        if done.any() and self.autoreset_mode == AutoresetMode.SAME_STEP:
            infos = self._final_infos(done, info, self._to_numpy(prepared, obs))
            state, obs = self._restart(prepared, jnp.asarray(done), state, obs)
        elif done.any():
            infos = info | {f"_{name}": done.copy() for name in INFO_FIELDS}  # gymnasium: the worlds that have values
        if self.autoreset_mode != AutoresetMode.SAME_STEP:
            self._has_ended = done
        self._episode = prepared, state, obs
        truncations = info["timed_out"] & done
        return self._to_numpy(prepared, obs), rewards, done & ~truncations, truncations, infos

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Return a picture of every world, uint8 [rows, columns, 3]; None without a `render_mode`."""
        after_fork.check()
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

    def _final_infos(self, done: np.ndarray, info: dict[str, np.ndarray], last: Any) -> dict[str, Any]:
        """Return `final_obs` and `final_info` of the ended worlds, of which `last` are the observations."""
        infos: dict[str, Any] = {}
        for world in np.flatnonzero(done):
            ended = {name: info[name][world] for name in INFO_FIELDS}
            final = {"final_obs": one_of(last, int(world)), "final_info": ended}
            infos = self._add_info(infos, final, int(world))
        return infos

    def _to_numpy(self, prepared: Any, obs: Any) -> Any:
        return as_dict(jax.tree.map(as_numpy, self._observe(prepared, obs)))


class KinetixEnv(gymnasium.Env):
    """One world. An ended episode needs a `reset`, which draws the next level."""

    metadata: dict[str, Any] = METADATA

    def __init__(
        self, config: EnvConfig, levels: Level | Callable[[], Level], *, render_mode: str | None = None
    ) -> None:
        """levels: [N, ...] on every field, or a function that returns them."""
        self.render_mode = render_mode
        if after_fork.is_forked() and config in _spaces:
            # A worker of gymnasium reports an error of `reset` to its parent, but not one of this function.
            self.observation_space, self.action_space = _spaces[config]
            return
        after_fork.check()
        pool = levels() if callable(levels) else levels
        self._vector = KinetixVectorEnv(config, pool, num_envs=1, render_mode=render_mode, autoreset=False)
        self.observation_space = self._vector.single_observation_space
        self.action_space = self._vector.single_action_space

    @property
    def _envs(self) -> KinetixVectorEnv:
        after_fork.check()
        return self._vector

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode. options: "level", number of the level to play, which is drawn at random by default."""
        envs = self._envs
        super().reset(seed=seed)
        number = _checked_options(options, OPTIONS).get("level")
        if number is None:
            number = self.np_random.integers(envs.num_levels)
        obs, _ = envs.reset(options={"levels": [number]})
        return one_of(obs, 0), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, infos = self._envs.step(np.asarray(action)[None])
        info = {name: infos[name][0] for name in INFO_FIELDS if name in infos}
        return one_of(obs, 0), float(reward[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray | None:
        pictures = self._envs.render()
        return None if pictures is None else pictures[0]


def make(
    *,
    size: str,
    levels: str | Level = RANDOM,
    num_levels: int | None = None,
    render_mode: str | None = None,
    **settings: Any,
) -> KinetixEnv:
    """Make one world, for `gymnasium.make("kinetix-dist/M-v0")`.

    Args:
      levels, num_levels: as in `kinetix_dist.make`.
      settings: fields of `EnvConfig`, such as `observation` and `action_space`.
    """
    config = _config(size, settings, make)
    return KinetixEnv(config, lambda: levels_of(config, levels, num_levels=num_levels)[0], render_mode=render_mode)


def make_vec(
    *,
    size: str,
    num_envs: int = 1,
    levels: str | Level = RANDOM,
    num_levels: int | None = None,
    render_mode: str | None = None,
    autoreset: bool | AutoresetMode = True,
    **settings: Any,
) -> KinetixVectorEnv:
    """Make many worlds, for `gymnasium.make_vec("kinetix-dist/M-v0")`.

    Args:
      levels, num_levels: as in `kinetix_dist.make`.
      autoreset: as in `KinetixVectorEnv`.
      settings: fields of `EnvConfig`, such as `observation` and `action_space`.
    """
    config = _config(size, settings, make_vec)
    pool, _ = levels_of(config, levels, num_levels=num_levels)
    return KinetixVectorEnv(config, pool, num_envs=num_envs, render_mode=render_mode, autoreset=autoreset)


def one_of(obs: Any, world: int) -> Any:
    """Return the observation of one world of a batch, [W, ...] on every array."""
    return {name: part[world] for name, part in obs.items()} if isinstance(obs, dict) else obs[world]


def _config(size: str, settings: dict[str, Any], function: Callable[..., Any]) -> EnvConfig:
    """Return the configuration. Raises TypeError for a keyword that neither it nor `function` has."""
    own = [name for name, x in inspect.signature(function).parameters.items() if x.kind == x.KEYWORD_ONLY]
    known = [field.name for field in dataclasses.fields(EnvConfig) if field.name not in own]
    for name in settings:
        if name not in known:
            hint = did_you_mean(name, [*own, *known], f"it takes {', '.join([*own, *known])}")
            raise TypeError(f"{function.__name__}() got an unexpected keyword argument {name!r}; {hint}")
    return EnvConfig(size=size, **settings)


def _info_arrays(info: StepInfo) -> dict[str, np.ndarray]:
    return {name: np.array(getattr(info, name)) for name in INFO_FIELDS}


def _checked_options(options: Mapping[str, Any] | None, known: Sequence[str]) -> Mapping[str, Any]:
    """Return the options. Raises TypeError for no mapping, and ValueError for an unknown name."""
    if not isinstance(options, Mapping | None):
        raise TypeError(f"options of reset are {options!r:.60}; give a dictionary, such as {{{known[0]!r}: ...}}")
    for name in options or {}:
        if name not in known:
            hint = did_you_mean(name, known, f"it takes {' and '.join(map(repr, known))}")
            raise ValueError(f"reset has no option {name!r}; {hint}")
    return options or {}


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


def _autoreset_mode(autoreset: bool | AutoresetMode) -> AutoresetMode:
    if isinstance(autoreset, bool):
        return AutoresetMode.SAME_STEP if autoreset else AutoresetMode.DISABLED
    try:
        return AutoresetMode(autoreset)
    except ValueError:
        modes = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ValueError(f"autoreset is {autoreset!r}; it can be True, False or one of {modes}") from None


def _check_render_mode(mode: str | None) -> None:
    if mode not in (None, *METADATA["render_modes"]):
        raise ValueError(f"render_mode is {mode!r}; it can be None or {' or '.join(METADATA['render_modes'])}")
