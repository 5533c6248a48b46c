"""Outcome of a step and the end of an episode: green shall touch blue and keep off red.

    touched blue                      the episode ends (solved)
    touched red                       the episode ends (failed); red wins when both happen in one step
    `max_steps` without either        the episode ends (timed out)

(Paper, section "RL Environment Specification".) A touch in any physics step of an environment step counts. With
several green or blue shapes the distance is that of the closest pair; without a pair it is 0. `rewards/` says what
these are worth.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jax2d.scene import Array, pack_bits
from kinetix_dist.level.level import Role


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class RoleMasks:
    """Shapes of each role, in the form that a step needs; computed once per level."""

    is_green: Array  # [W, n] bool, active shapes only
    is_blue: Array  # [W, n] bool
    blue_bits: Array  # [W, words] uint32, bit i set when shape i is blue
    red_bits: Array  # [W, words] uint32


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of a step. At most one of the four is True; the episode goes on when none is."""

    solved: Array  # [W] bool, green touched blue and not red
    failed: Array  # [W] bool, green touched red
    timed_out: Array  # [W] bool, the time limit came first
    unstable: Array  # [W] bool, the physics gave a number that is not finite; the episode is dropped with reward 0

    @property
    def done(self) -> Array:
        return self.solved | self.failed | self.timed_out | self.unstable


def role_masks(shape_role: Array, shape_active: Array) -> RoleMasks:
    """shape_role [W, n] int32 and shape_active [W, n] bool to masks; inactive shapes play no role."""
    is_green, is_blue, is_red = (shape_active & (shape_role == role) for role in (Role.GREEN, Role.BLUE, Role.RED))
    return RoleMasks(is_green=is_green, is_blue=is_blue, blue_bits=pack_bits(is_blue), red_bits=pack_bits(is_red))


def goal_distance(position: Array, masks: RoleMasks) -> Array:
    """[W] m: from the centre of green to that of blue (the closest pair), 0 in worlds without a pair."""
    offset = position[:, :, None, :] - position[:, None, :, :]
    is_pair = masks.is_green[:, :, None] & masks.is_blue[:, None, :]
    squared = jnp.where(is_pair, (offset**2).sum(-1), jnp.inf).min(axis=(1, 2))
    return jnp.where(jnp.isinf(squared), 0.0, jnp.sqrt(squared))


def judge(touching: Array, masks: RoleMasks, *, is_finite: Array, is_last_step: Array) -> Outcome:
    """Outcome of a step. touching [W, n, words] uint32: who touched whom in it; is_finite, is_last_step [W] bool."""
    touched = jnp.where(masks.is_green[:, :, None], touching, jnp.uint32(0))
    touched_blue = ((touched & masks.blue_bits[:, None, :]) != 0).any(axis=(1, 2))
    touched_red = ((touched & masks.red_bits[:, None, :]) != 0).any(axis=(1, 2))
    failed = is_finite & touched_red
    solved = is_finite & touched_blue & ~touched_red
    timed_out = is_finite & is_last_step & ~failed & ~solved
    return Outcome(solved=solved, failed=failed, timed_out=timed_out, unstable=~is_finite)
