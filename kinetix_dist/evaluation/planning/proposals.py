"""Sequences of actions to try: held for random durations, and variants of the sequence that came nearest.

A variant follows its base with some patches: a stretch is replaced by one random action, left out, or stretched by
holding the action before it. After the end of the base it goes on with random held actions. Works inside jit.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array
from kinetix_dist import prng
from kinetix_dist.env.action_spaces import ActionSpace
from kinetix_dist.evaluation.planning.problems import over_actions
from kinetix_dist.evaluation.search.sampling import MAX_HOLD, MIN_HOLD

NUM_PATCHES = 3  # at most
MAX_PATCH = 64  # steps
REPLACED, LEFT_OUT, STRETCHED = range(3)


def held_actions(space: ActionSpace, key: Array, num_steps: int, num_worlds: int) -> Array:
    """[T, W, ...]: random actions that change at random moments, in some worlds often and in some seldom."""
    hold_key, change_key, draw_key = prng.split(key, 3)
    changes = is_changed(change_key, durations(hold_key, num_worlds, MIN_HOLD, MAX_HOLD), num_steps)
    drawn = space.sample(draw_key, num_steps * num_worlds)
    drawn = drawn.reshape(num_steps, num_worlds, *drawn.shape[1:])
    last_change = jax.lax.cummax(jnp.where(changes, jnp.arange(num_steps)[:, None], 0), axis=0)
    return jnp.take_along_axis(drawn, over_actions(last_change, drawn), axis=0)


def durations(key: Array, num_worlds: int, shortest: int, longest: int) -> Array:
    """[W] float32, log-uniform."""
    return jnp.exp(prng.uniform(key, (num_worlds,), np.log(shortest), np.log(longest)))


def is_changed(key: Array, duration: Array, num_steps: int) -> Array:
    """[T, W] bool: the first step, and others with the chance that lets actions last `duration` [W] on average."""
    changes = prng.uniform(key, (num_steps, duration.shape[0])) < 1.0 / duration
    return changes.at[0].set(True)


def variants(space: ActionSpace, key: Array, base: Array, base_length: Array) -> Array:
    """[T, W, ...]: variants of bases [T, W, ...], each of `base_length` [W] steps."""
    num_steps, num_worlds = base.shape[:2]
    tail_key, patch_key = prng.split(key)
    tail = held_actions(space, tail_key, num_steps, num_worlds)
    number_key, start_key, length_key, kind_key, draw_key = prng.split(patch_key, 5)
    shape = (NUM_PATCHES, num_worlds)
    is_used = jnp.arange(NUM_PATCHES)[:, None] < prng.randint(number_key, (num_worlds,), 0, NUM_PATCHES + 1)
    start = (prng.uniform(start_key, shape) * base_length).astype(jnp.int32)
    length = jnp.exp(prng.uniform(length_key, shape, 0.0, np.log(MAX_PATCH))).astype(jnp.int32)
    kind = jnp.where(is_used, prng.randint(kind_key, shape, 0, 3), -1)
    drawn = space.sample(draw_key, NUM_PATCHES * num_worlds)
    drawn = drawn.reshape(*shape, *drawn.shape[1:])

    step = jnp.arange(num_steps)[:, None]
    index = jnp.broadcast_to(step, (num_steps, num_worlds))
    for i in range(NUM_PATCHES):
        is_after = step >= start[i]
        index = index + jnp.where((kind[i] == LEFT_OUT) & is_after, length[i], 0)
        index = index - jnp.where(kind[i] == STRETCHED, jnp.clip(step - start[i], 0, length[i]), 0)
    index = jax.lax.cummax(jnp.maximum(index, 0), axis=0)  # where patches overlap, the base is held and not undone
    followed = jnp.take_along_axis(base, over_actions(jnp.minimum(index, num_steps - 1), base), axis=0)
    for i in range(NUM_PATCHES):
        is_inside = (kind[i] == REPLACED) & (step >= start[i]) & (step < start[i] + length[i])
        followed = jnp.where(over_actions(is_inside, followed), drawn[i][None], followed)
    return jnp.where(over_actions(index < base_length, followed), followed, tail)
