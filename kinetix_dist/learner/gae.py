"""Generalised advantage estimation (Schulman et al. 2016).

delta_t     = reward_t + discount (1 - done_after_t) value_{t+1} - value_t
advantage_t = delta_t + discount trace (1 - done_after_t) advantage_{t+1}
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array

_STEPS_A_LOOP = 16  # on a GPU the loop is bound by the launch of its small kernels


def gae(rewards: Array, values: Array, done_after: Array, last_value: Array, *, discount: float, trace: float) -> Array:
    """Advantages [T, W] float32. The regression target of the value is `advantages + values`.

    rewards, values: [T, W]; done_after: [T, W] bool, the episode ended with step t, so that nothing that follows
    counts (the time limit ends an episode like any other outcome, as in the paper); last_value: [W], of the
    observation after the last step. trace: lambda; 0 gives one-step errors, 1 gives returns minus values.
    """
    next_values = jnp.concatenate([values[1:], last_value[None]])
    continues = discount * (1.0 - done_after.astype(jnp.float32))
    deltas = rewards + continues * next_values - values

    def step(advantage: Array, at: tuple[Array, Array]) -> tuple[Array, Array]:
        delta, keeps = at
        advantage = delta + trace * keeps * advantage
        return advantage, advantage

    unroll = min(_STEPS_A_LOOP, rewards.shape[0])
    _, advantages = jax.lax.scan(step, jnp.zeros_like(last_value), (deltas, continues), reverse=True, unroll=unroll)
    return advantages
