"""Layer norm and mean over tokens, as rows that a GPU stores before and after (stored.py)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from jax2d.scene import Array
from kinetix_dist.models.linear import stored

NORM_EPSILON = 1e-6


@jax.custom_vjp
def masked_mean(x: Array, mask: Array) -> Array:
    """Mean in float32 over the tokens that exist, [B, F] of [B, n, F]; at least one does (the dummy token)."""
    return _masked_mean_forward(x, mask)[0]


def _masked_mean_forward(x: Array, mask: Array) -> tuple[Array, tuple[Array, Array]]:
    # Else XLA takes the division by a sum and what follows for a softmax.
    x, weight = stored((x, mask.astype(jnp.float32) / jnp.sum(mask, axis=1, keepdims=True)))
    total = jnp.zeros((x.shape[0], x.shape[2]), jnp.float32)
    for token in range(x.shape[1]):
        total = total + weight[:, token, None] * x[:, token].astype(jnp.float32)
    return total, (weight, jnp.zeros(0, x.dtype))


def _masked_mean_backward(residuals: tuple[Array, Array], grad: Array) -> tuple[Array, None]:
    weight, like = residuals
    return (weight[:, :, None] * grad[:, None]).astype(like.dtype), None


masked_mean.defvjp(_masked_mean_forward, _masked_mean_backward)


@jax.custom_vjp
def normalise(x: Array) -> Array:
    """Layer norm without scale and offset: zero mean and unit variance over the last axis, computed in float32."""
    return _normalise_forward(x)[0]


@jax.custom_vjp
def norm_branch(x: Array) -> tuple[Array, Array]:
    """`x` and `normalise(x)`, for the stream and its branch: one loop adds up the gradients of both."""
    return x, normalise(x)


def _normalise_forward(x: Array) -> tuple[Array, tuple[Array, Array]]:
    wide = _stored_rows(x)
    centred = wide - jnp.mean(wide, axis=-1, keepdims=True)
    inverse_std = jax.lax.rsqrt(jnp.mean(centred * centred, axis=-1, keepdims=True) + NORM_EPSILON)
    normal = (centred * inverse_std).astype(x.dtype).reshape(x.shape)
    return normal, (normal, inverse_std)


def _normalise_backward(residuals: tuple[Array, Array], grad: Array) -> tuple[Array]:
    return (_as(grad, _grad_of_rows(residuals, grad)),)


def _norm_branch_forward(x: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    normal, residuals = _normalise_forward(x)
    return (x, normal), residuals


def _norm_branch_backward(residuals: tuple[Array, Array], grads: tuple[Array, Array]) -> tuple[Array]:
    of_stream, of_norm = grads
    return (_as(of_stream, _stored_rows(of_stream) + _grad_of_rows(residuals, of_norm)),)


def _grad_of_rows(residuals: tuple[Array, Array], grad: Array) -> Array:
    """[rows, F] float32: of what was normalised."""
    normal, inverse_std = _stored_rows(residuals[0]), residuals[1]
    wide = _stored_rows(grad)
    along = jnp.mean(wide * normal, axis=-1, keepdims=True)
    return (wide - jnp.mean(wide, axis=-1, keepdims=True) - normal * along) * inverse_std


def _stored_rows(x: Array) -> Array:
    """[..., F] as [rows, F] in float32, read from memory."""
    return stored(x.reshape(-1, x.shape[-1])).astype(jnp.float32)


def _as(like: Array, rows: Array) -> Array:
    """[rows, F] in type and shape of `like`, stored."""
    return stored(rows.astype(like.dtype)).reshape(like.shape)


normalise.defvjp(_normalise_forward, _normalise_backward)
norm_branch.defvjp(_norm_branch_forward, _norm_branch_backward)
