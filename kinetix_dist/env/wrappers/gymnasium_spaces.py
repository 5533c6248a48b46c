"""Spaces of gymnasium for observations and actions of one world."""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import jax
import numpy as np
from gymnasium import spaces

from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.env.environment import Environment


class NamedArrays(spaces.Dict):
    """A Dict of arrays. Wrappers that need a single array raise one line that names the remedy.

    `NormalizeObservation` asserts that the space has a shape, without a message.
    """

    @property
    def shape(self) -> None:
        """None. Raises TypeError if a wrapper of gymnasium reads it."""
        if str(sys._getframe(1).f_globals.get("__name__")).startswith("gymnasium.wrappers."):
            raise TypeError(
                "this wrapper needs one array, but entity observations are a Dict of arrays; make the environment with "
                'observation="flat", or wrap it in gymnasium.wrappers.FlattenObservation first'
            )
        return None


def observation_space(env: Environment) -> spaces.Space:
    """Return a Box, or a Dict with the fields of an `EntityObs`."""
    obs = env.observation_space
    if dataclasses.is_dataclass(obs):
        return NamedArrays({name: _space_of(part, env) for name, part in vars(obs).items()})
    return _space_of(obs, env)


def action_space(space: ActionSpace) -> spaces.Space:
    """Return a Box of continuous actions, else a Discrete or a MultiDiscrete."""
    if not space.is_integer:
        return spaces.Box(np.asarray(space.low, np.float32), np.asarray(space.high, np.float32), dtype=np.float32)
    choices = np.asarray(space.high, np.int64) + 1
    return spaces.Discrete(int(choices[0])) if space.is_flat else spaces.MultiDiscrete(choices)


def as_dict(obs: Any) -> Any:
    """Return the fields of a dataclass by name; an array as it is."""
    return vars(obs) if dataclasses.is_dataclass(obs) else obs


def as_numpy(x: Any) -> np.ndarray:
    """Return a copy of an array; booleans as int8 0 and 1, as the space has them."""
    return np.array(x, np.int8 if x.dtype == np.bool_ else None)


def _space_of(part: jax.ShapeDtypeStruct, env: Environment) -> spaces.Box:
    if part.dtype == np.bool_:  # TorchRL reads no MultiBinary of several axes
        return spaces.Box(0, 1, part.shape, np.int8)
    if part.dtype == np.float32:
        return spaces.Box(-np.inf, np.inf, part.shape, np.float32)
    highest = 255 if part.dtype == np.uint8 else env.capacity.shapes - 1  # of a picture, or the number of a shape
    return spaces.Box(0, highest, part.shape, part.dtype)
