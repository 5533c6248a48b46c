"""Flow matching with linear interpolation (Lipman et al. 2023; Liu et al. 2023): interpolation, loss, Euler steps.

    x_t = (1 - t) noise + t action,  t from 0 (noise) to 1 (data)      velocity to learn: action - noise
    x_{t + 1/K} = x_t + v(x_t, t) / K                                  K steps from noise make a sample

Chunks are [B, H, A] in units of -1..1. Each action of a chunk has its own flow time, [B, H]: 1 for those that are given
without noise, a prefix (training-time RTC: Black et al., Training-Time Action Conditioning for Efficient Real-Time
Chunking, 2025), which count neither in the loss nor are they moved by the integration.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist import prng

Velocity = Callable[[Array, Array], Array]  # (chunk [B, H, A], time [B, H]) -> velocity [B, H, A]


class Draw(NamedTuple):
    """Random numbers of a loss over B chunks."""

    noise: Array  # [B, H, A]
    time: Array  # [B] in [0, 1)
    prefix: Array  # [B] int32: so many first actions are given


def draw(key: Array, shape: tuple[int, int, int], max_prefix: Array | int) -> Draw:
    """Normal noise, uniform times and uniform prefixes of 0 to `max_prefix` actions. Consumes the key."""
    of_noise, of_time, of_prefix = prng.split(key, 3)
    return Draw(
        noise=prng.normal(of_noise, shape),
        time=prng.uniform(of_time, shape[:1]),
        prefix=prng.randint(of_prefix, shape[:1], 0, max_prefix + 1),
    )


def flow_loss(velocity: Velocity, actions: Array, drawn: Draw, weight: Array) -> Array:
    """Mean square error of the velocity over numbers that count. weight [B, H, A]: 1 where a number counts, else 0."""
    is_given = prefix_mask(drawn.prefix, actions.shape[1])
    time = jnp.where(is_given, 1.0, drawn.time[:, None])
    error = velocity(interpolated(drawn.noise, actions, time), time) - (actions - drawn.noise)
    weight = weight * ~is_given[..., None]
    return jnp.sum(weight * jnp.square(error)) / jnp.maximum(jnp.sum(weight), 1.0)


def interpolated(noise: Array, actions: Array, time: Array) -> Array:
    """x_t. time [B, H]."""
    return (1.0 - time[..., None]) * noise + time[..., None] * actions


def prefix_mask(prefix: Array, horizon: int) -> Array:
    """[..., H] bool: the first `prefix` [...] actions."""
    return jnp.arange(horizon) < jnp.asarray(prefix)[..., None]


def integrate(velocity: Velocity, noise: Array, num_steps: int) -> Array:
    """Chunks [B, H, A] that the flow makes of noise in `num_steps` Euler steps."""

    def step(x: Array, number: Array) -> tuple[Array, None]:
        time = jnp.full(x.shape[:2], number / num_steps, x.dtype)
        return x + velocity(x, time) / num_steps, None

    return jax.lax.scan(step, noise, jnp.arange(num_steps, dtype=jnp.float32))[0]


def integrate_after(velocity: Velocity, noise: Array, num_steps: int, given: Array, is_given: Array) -> Array:
    """The same with actions `given` [B, H, A] where `is_given` [..., H]: the flow makes the others to follow them."""
    mask = jnp.broadcast_to(is_given, noise.shape[:2])

    def of_others(x: Array, time: Array) -> Array:
        return velocity(jnp.where(mask[..., None], given, x), jnp.where(mask, 1.0, time))

    return jnp.where(mask[..., None], given, integrate(of_others, noise, num_steps))
