"""Plane vectors as arrays `[..., 2]`, and helpers whose gradients are finite where the kernel would branch."""

from __future__ import annotations

from typing import overload

import jax
import jax.numpy as jnp
import numpy as np


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1]


@overload
def cross(a: jax.Array, b: jax.Array) -> jax.Array: ...
@overload
def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray: ...
def cross(a: jax.Array | np.ndarray, b: jax.Array | np.ndarray) -> jax.Array | np.ndarray:
    """Returns an array of the kind that it gets: builders and rules of scenes work on numpy's float64."""
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def left(v: jax.Array) -> jax.Array:
    """Rotated by +90 degrees: omega x r = left(r) * omega."""
    return jnp.stack([-v[..., 1], v[..., 0]], -1)


def right(v: jax.Array) -> jax.Array:
    """Rotated by -90 degrees."""
    return jnp.stack([v[..., 1], -v[..., 0]], -1)


def from_angle(angle_rad: jax.Array) -> jax.Array:
    return jnp.stack([jnp.cos(angle_rad), jnp.sin(angle_rad)], -1)


def rotated(v: jax.Array, angle_rad: jax.Array) -> jax.Array:
    c, s = jnp.cos(angle_rad), jnp.sin(angle_rad)
    return jnp.stack([c * v[..., 0] - s * v[..., 1], s * v[..., 0] + c * v[..., 1]], -1)


def sqrt_or_zero(x: jax.Array) -> jax.Array:
    """Square root with zero gradient, not an infinite one, at zero."""
    is_positive = x > 0
    return jnp.where(is_positive, jnp.sqrt(jnp.where(is_positive, x, 1)), 0)


def length(v: jax.Array) -> jax.Array:
    return sqrt_or_zero(dot(v, v))


def inverse_or_zero(x: jax.Array) -> jax.Array:
    is_positive = x > 0
    return jnp.where(is_positive, 1 / jnp.where(is_positive, x, 1), 0)


def unit_or_zero(v: jax.Array) -> jax.Array:
    return v * inverse_or_zero(length(v))[..., None]


def clamp_length(v: jax.Array, max_length: float | jax.Array) -> jax.Array:
    """v [2], or of length `max_length` where it is longer."""
    squared = dot(v, v)
    is_long = squared > max_length * max_length
    return jnp.where(is_long, v * (max_length / jnp.sqrt(jnp.where(is_long, squared, 1))), v)
