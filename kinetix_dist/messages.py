"""Types that cross parts and processes: what a rollout hands to the learner and to the curator.

Both are pytrees, so that they can be sharded, moved with `jax.device_get` and stored in checkpoints. Time comes first,
then worlds: [T, W, ...]; worlds are what is sharded over devices.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from jax2d.scene import Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Trajectory:
    """T environment steps of W worlds. Only what changes from step to step: static observations stay with levels."""

    dynamic_obs: Any  # [T, W, ...], what the policy saw before it acted, see `Observation.dynamic`
    actions: Array  # [T, W, ...], in the type in which the action space stores them
    log_probs: Array  # [T, W] float32, of the actions under the policy that took them
    values: Array  # [T, W] float32
    rewards: Array  # [T, W] float32
    done_after: Array  # [T, W] bool, the episode ended with this step (also at the time limit)
    timed_out: Array | None = None  # [T, W] bool, it ended so at the time limit; None: not recorded


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class StaticInput:
    """Parts of the learner's input that are the same in all steps of an update, of W worlds."""

    obs: Any  # [W, ...], see `Observation.static`
    bound_heads: Array | None = None  # [W, heads] bool, see `ActionSpace.bound_heads`; None: all heads count
    memory: Array | None = None  # [W, size] of the policy before the first step; None: worlds begin with an episode


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class PhysicsCounts:
    """Counters of the physics, the action space and the reward for each world, summed over steps. All but
    `speed_limited` are zero in a healthy run. Fields are those of the environment's `StepInfo`."""

    unstable: Array  # [W] int32, times that the world was not finite and was reset
    contact_overflow: Array  # [W] int32, contacts without a slot
    speed_limited: Array  # [W] int32, bodies on which a speed limit acted, each once a physics step
    missing_effects: Array  # [W] int32, steps in which the engine lacked an effect
    invalid_actions: Array  # [W] int32, action numbers out of range
    invalid_rewards: Array  # [W] int32, rewards that were not finite
    invalid_controls: Array  # [W] int32, controls out of range or NaN
    invalid_scene: Array  # [W] int32, joints, thrusters and polygons that make no sense, once a step


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class LevelOutcome:
    """Outcome of each level, world by world: its first episode, and sums over all episodes that finished.

    Over many worlds count first episodes (`actors/outcomes.py`): a world whose episodes end early finishes more.
    """

    first_solved: Array  # [W] int32, 1 where the first episode ended and was solved: green touched blue
    first_failed: Array  # [W] int32, 1 where it ended and failed: green touched red
    first_return: Array  # [W] float32, undiscounted return of the first episode, so far where it has not ended
    num_finished: Array  # [W] int32, episodes
    num_solved: Array  # [W] int32
    return_sum: Array  # [W] float32, undiscounted returns
    length_sum: Array  # [W] int32, environment steps
    physics: PhysicsCounts  # [W] of all steps, of unfinished episodes too
    summary: Any = None  # any pytree, worlds first: what the curriculum's `summarise` made of the trajectory
