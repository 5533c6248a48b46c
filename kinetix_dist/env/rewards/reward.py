"""Interface of a reward: a pure function of one environment step of a batch of worlds.

A new reward is one file with a `Reward` and its registration: docs/extending.md.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

from jax2d.scene import Array, Controls
from kinetix_dist.env.outcome import Outcome, RoleMasks
from kinetix_dist.level.level import Level


@dataclasses.dataclass(frozen=True, kw_only=True)
class Bodies:
    """Positions and velocities of the shapes of a batch of worlds."""

    position: Array  # [W, n, 2] m
    angle: Array  # [W, n] rad
    velocity: Array  # [W, n, 2] m/s
    angular_velocity: Array  # [W, n] rad/s

    @classmethod
    def of(cls, bodies: tuple[Array, Array, Array, Array]) -> Bodies:
        """Bodies as `Engine.bodies` gives them."""
        position, angle, velocity, angular_velocity = bodies
        return cls(position=position, angle=angle, velocity=velocity, angular_velocity=angular_velocity)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Step:
    """One environment step, as rewards see it. `after` is the state the step led to, before any restart."""

    # Level:
    level: Any  # [W, ...], what `Reward.static` gave
    roles: RoleMasks  # [W, ...], who is green, blue and red
    # Step:
    before: Bodies
    after: Bodies
    distance_before: Array  # [W] m, of green and blue
    distance_after: Array  # [W] m
    actions: Array  # [W, ...], as the policy gave them
    controls: Controls  # of motors [W, J] and thrusters [W, T], what the actions did
    outcome: Outcome  # [W] bool each: solved, failed, timed_out, unstable, and `done`, one of them
    num_steps: Array  # [W] int32, environment steps of the episode, this one included
    # Settings of `EnvConfig`:
    failure_penalty: float
    dense_scale: float  # `dense_reward_scale`
    discount: float  # `shaping_discount`


class Reward(abc.ABC):
    """Reward by name, `EnvConfig.reward`. It keeps no state: runs of equal settings share it."""

    uses_dense_scale: bool = True  # False: `dense_reward_scale` changes nothing
    uses_discount: bool = True  # False: `shaping_discount` changes nothing and may differ from the learner's

    def static(self, levels: Level) -> Any:
        """Part that a batch of levels fixes, [W, ...], computed once; `Step.level`. None where nothing is needed."""
        del levels
        return None

    @abc.abstractmethod
    def reward(self, step: Step) -> Array:
        """[W] float32. Worlds that are `unstable` get 0 whatever it says; a number that is not finite counts as 0 and
        is reported (`StepInfo.invalid_rewards`)."""
