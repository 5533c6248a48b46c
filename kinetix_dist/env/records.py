"""Inputs and outputs of an environment: prepared levels, states of episodes, information about a step."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from jax2d.scene import Array
from kinetix_dist.env.outcome import RoleMasks


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class PreparedLevels:
    """All that a batch of levels contributes to a step. Only selected from, never changed, by reset and step."""

    packed_scene: Any  # jax2d packed scene, [field, W]
    initial_packed_state: Any  # jax2d packed state, [field, W]
    initial_obs: Any  # [W, ...], see `Observation.dynamic`
    initial_distance: Array  # [W] m, of green and blue
    static_obs: Any  # [W, ...], see `Observation.static`
    static_reward: Any  # [W, ...], see `Reward.static`
    bound_heads: Array | None  # [W, dimensions] bool, see `ActionSpace.bound_heads`
    roles: RoleMasks  # [W, ...]
    motor_colour: Array  # [W, J] int32
    motor_auto: Array  # [W, J] bool
    thruster_colour: Array  # [W, T] int32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class EnvState:
    """State of a batch of episodes."""

    packed_state: Any  # jax2d packed state, [field, W]
    distance: Array  # [W] m, of green and blue now
    num_steps: Array  # [W] int32, environment steps taken in this episode
    episode_return: Array  # [W] float32, undiscounted sum of rewards of this episode


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class StepInfo:
    """Outcomes and counters of a step. Outcomes are True only in the step that ends an episode, one of them at most."""

    solved: Array  # [W] bool, green touched blue
    failed: Array  # [W] bool, green touched red
    timed_out: Array  # [W] bool, `max_steps` passed
    unstable: Array  # [W] bool, the physics gave a number that is not finite; reward 0
    episode_return: Array  # [W] float32, of the episode so far, this step included (the final value where done)
    episode_length: Array  # [W] int32, likewise
    invalid_actions: Array  # [W] int32, numbers of this step's action that were out of range and acted as "off"
    invalid_rewards: Array  # [W] bool, the reward of this step was not finite and counts as 0
    invalid_controls: Array  # [W] int32, controls that the engine found out of range or NaN
    invalid_scene: Array  # [W] int32, joints, thrusters and polygons of the level that make no sense to the engine
    contact_overflow: Array  # [W] int32, contacts that found no slot in the engine (0 unless built too small)
    speed_limited: Array  # [W] int32, bodies on which a speed limit of the physics acted, each once a step
    missing_effects: Array  # [W] int32, what an engine made for fewer effects lacks, as bits: `Touching.missing`
