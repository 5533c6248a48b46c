"""Windows of a data set: at each step what was seen, and the chunk of actions that follow it in the same episode.

A window never crosses the end of an episode: behind it the last action is repeated, so that a chunk looks like one, and
`counts` is False. Nor do actions count that the policy did not choose: noise, and repeats of the one before.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist.models.flow_network import Remembered


class Samples(NamedTuple):
    """Steps of episodes: rows of an episode lie one after the other."""

    static_obs: Any  # [L, ...] of each level, see `Observation.static`
    bound: Array  # [L, A] bool, see `ActionSpace.bound_heads`
    dynamic_obs: Any  # [N, ...]
    level: Array  # [N] int32, index into static_obs
    actions: Array  # [N, A] float32, in -1..1
    left: Array  # [N] int32: steps of the episode from this one on, this one included
    counts: Array  # [N] bool: the action is the policy's, and not what disturbed it


class Windows(NamedTuple):
    """Chunks of B rows."""

    actions: Array  # [B, H, A]
    counts: Array  # [B, H] bool: within the episode, and chosen by the policy


def steps_left(episode: np.ndarray) -> np.ndarray:
    """`Samples.left` of the number of each row's episode, [N]. Raises ValueError where rows of an episode are apart."""
    if not len(episode):
        return np.zeros(0, np.int32)
    starts = np.flatnonzero(np.r_[True, episode[1:] != episode[:-1]])
    if len(np.unique(episode)) != len(starts):
        raise ValueError("rows of an episode are apart; sort them by episode and step")
    ends = np.r_[starts[1:], len(episode)]
    return (np.repeat(ends, ends - starts) - np.arange(len(episode))).astype(np.int32)


def windows(samples: Samples, rows: Array, horizon: int) -> Windows:
    """Chunks that begin with `rows` [B]. Pure; works inside jit."""
    ahead, left = jnp.arange(horizon), samples.left[rows][:, None]
    index = rows[:, None] + jnp.minimum(ahead, left - 1)
    return Windows(samples.actions[index], (ahead < left) & samples.counts[index])


def observations(env: Any, samples: Samples, rows: Array, history: int = 0) -> tuple[Any, Array]:
    """(inputs of a network, bound dimensions) of rows [B]: joined observations, with as many steps of `history` before
    them as in play (history.py)."""
    level = samples.level[rows]
    bound = samples.bound[level]
    now = _joined(env, samples, level, rows)
    if not history:
        return now, bound
    back, here = jnp.arange(1, history + 1), rows[:, None]
    # Rows of an episode count down to its end: one of another episode has fewer left than that.
    is_there = (here >= back) & (samples.left[jnp.maximum(here - back, 0)] == samples.left[here] + back)
    index = jnp.maximum(here - back, here - jnp.sum(is_there, axis=1, keepdims=True))
    past = jax.vmap(lambda earlier: _joined(env, samples, level, earlier), in_axes=1, out_axes=1)(index)
    actions = jnp.where(is_there[..., None] & bound[:, None], samples.actions[index], 0.0)
    return Remembered(now, past, actions), bound


def _joined(env: Any, samples: Samples, level: Array, rows: Array) -> Any:
    static = jax.tree.map(lambda x: x[level], samples.static_obs)
    return env.observation.join(static, jax.tree.map(lambda x: x[rows], samples.dynamic_obs))
