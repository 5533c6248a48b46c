"""Interface of an observation, which environment, actors, learner and evaluation share.

An observation is stored in two parts, because memory is what a rollout runs out of: what a level fixes, computed once,
and what changes from step to step. They are joined to the input of a policy when (and where) it is needed.

A new observation is one file with an `Observation` and its registration: docs/extending.md.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar

import jax

from jax2d.scene import Array
from kinetix_dist.level.level import Level

ENTITIES = "entities"  # an `entities.EntityObs`
VECTOR = "vector"  # [B, features] float32
IMAGE = "image"  # [B, rows, columns, 3] uint8


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Moving:
    """Positions and motion of a batch of worlds."""

    position: Array  # [W, n, 2] m
    angle: Array  # [W, n] rad
    velocity: Array  # [W, n, 2] m/s
    angular_velocity: Array  # [W, n] rad/s
    touching: Array  # [W, n, words] uint32, see `jax2d.scene.Touching`; zero right after a reset
    has_stepped: Array  # [W] bool, false right after a reset


class Observation(abc.ABC):
    """Three pure functions of batches of worlds. All parts are pytrees of arrays with the world axis first."""

    gives: str  # kind of policy input: ENTITIES, VECTOR, IMAGE or one of your own; networks say which they take
    working_bytes: int = 0  # of device memory that `join` takes for a world; 0: too few to count
    # For readers of data sets, by path through `dynamic`: names along the last axis, and the mask in `static` whose
    # False rows hold nothing. What is not named here stands in a data set with its shape alone.
    entries: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    masks: ClassVar[Mapping[str, str]] = {}

    @abc.abstractmethod
    def static(self, levels: Level) -> Any:
        """Part that a batch of levels fixes, [W, ...]."""

    @abc.abstractmethod
    def dynamic(self, moving: Moving) -> Any:
        """Part that changes from step to step, [W, ...]; trajectories store it for every step, so keep it small."""

    @abc.abstractmethod
    def join(self, static: Any, dynamic: Any) -> Any:
        """The input of a policy, [W, ...]."""
