"""Real-time chunking (RTC): a flow guided towards what is left of the chunk before.

Black, Galliker and Levine, Real-Time Execution of Action Chunking Flow Policies (2025), section 3. The new chunk is
inpainted: its first d actions are those that are executed while it is computed, the next ones may differ from the old
plan, the less the nearer they are, and the last s have no old plan. With the estimate of the final chunk

    x1(x, t) = x + (1 - t) v(x, t)

the flow's velocity gets a pull towards the old chunk Y (pseudoinverse guidance, Song et al. 2023; eq. 2 to 4):

    v' = v + min(beta, (1 - t) / (t r^2)) J^T W (Y - x1),    r^2 = (1 - t)^2 / (t^2 + (1 - t)^2),   J = dx1 / dx

W is diagonal, `soft_weights`. Few integration steps need the limit beta: at t = 0 the weight has none.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.delay.flow_matching import Velocity

MAX_GUIDANCE = 5.0  # beta; the paper's for 5 integration steps


def soft_weights(delay: Array | int, known: Array | int, horizon: int) -> Array:
    """W, [H]: how much each action of a new chunk is held to the old one (eq. 5).

        i < delay             1: it will have been executed
        delay <= i < known    c (e^c - 1) / (e - 1),  c = (known - i) / (known - delay + 1)
        known <= i            0: the old chunk ends before it

    delay and known, the number of actions that are left of the old chunk, may be traced; delay <= known.
    """
    i = jnp.arange(horizon, dtype=jnp.float32)
    c = jnp.clip((known - i) / (jnp.asarray(known) - delay + 1.0), 0.0, 1.0)
    return jnp.where(i < delay, 1.0, jnp.where(i < known, c * jnp.expm1(c) / (math.e - 1.0), 0.0))


def guidance_weight(time: Array, max_weight: float = MAX_GUIDANCE) -> Array:
    """min(beta, (1 - t) / (t r^2)): beta at t = 0, and where t is 1 no action has far to go."""
    rest = 1.0 - time
    weight = (jnp.square(time) + jnp.square(rest)) / jnp.maximum(time * rest, 1e-9)
    return jnp.minimum(weight, max_weight)


def guided(velocity: Velocity, target: Array, weights: Array, max_weight: float = MAX_GUIDANCE) -> Velocity:
    """The velocity with the pull towards `target` [B, H, A]; weights: W, broadcast to it."""

    def corrected(x: Array, time: Array) -> Array:
        def final_estimate(x: Array) -> tuple[Array, Array]:
            v = velocity(x, time)
            return x + (1.0 - time[..., None]) * v, v

        estimate, pull_back, v = jax.vjp(final_estimate, x, has_aux=True)
        (correction,) = pull_back(weights * (target - estimate))
        return v + guidance_weight(time, max_weight)[..., None] * correction

    return corrected
