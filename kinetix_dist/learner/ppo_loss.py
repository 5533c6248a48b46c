"""Clipped PPO (Schulman et al. 2017) with a clipped value loss: sums over samples, so that shards can be added.

ratio  = exp(log_prob - old_log_prob)
policy = -mean min(ratio A, clip(ratio, 1 - c, 1 + c) A)
value  = 1/2 mean max((v - target)^2, (old_v + clip(v - old_v, -c, c) - target)^2)
loss   = policy + value_coefficient value - entropy_coefficient entropy
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp

from jax2d.scene import Array

LOSS_METRICS = ("policy_loss", "value_loss", "entropy", "approx_kl", "clip_fraction")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class Samples:
    """Input of the loss for B samples, but for the observation."""

    actions: Array  # [B, heads] integers
    old_log_probs: Array  # [B] float32
    old_values: Array  # [B] float32
    advantages: Array  # [B] float32, normalised
    targets: Array  # [B] float32, of the value
    is_counted: Array | None = None  # [B] bool, whether a sample is part of the sums; None: all are
    bound_heads: Array | None = None  # [B, heads] bool, those that count in log-probability and entropy; None: all


def ppo_terms(
    log_probs: Array,
    entropies: Array,
    values: Array,
    samples: Samples,
    *,
    clip: Array | float,
    value_clip: Array | float | None,
) -> Array:
    """Sums over the samples of the five LOSS_METRICS, in their order: [5] float32. `value_clip` None: not clipped."""
    log_ratio = log_probs - samples.old_log_probs
    ratio = jnp.exp(log_ratio)
    clipped_ratio = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    policy = -jnp.minimum(ratio * samples.advantages, clipped_ratio * samples.advantages)
    error = jnp.square(values - samples.targets)
    if value_clip is not None:
        clipped_value = samples.old_values + jnp.clip(values - samples.old_values, -value_clip, value_clip)
        error = jnp.maximum(error, jnp.square(clipped_value - samples.targets))
    approx_kl = ratio - 1.0 - log_ratio  # of old from new; never negative, lower variance than -log_ratio
    is_clipped = jnp.abs(ratio - 1.0) > clip
    terms = (policy, 0.5 * error, entropies, approx_kl, is_clipped.astype(jnp.float32))
    if samples.is_counted is not None:
        terms = tuple(jnp.where(samples.is_counted, term, 0.0) for term in terms)
    return jnp.stack([jnp.sum(term) for term in terms])


def total_loss(terms: Array, *, value_coefficient: float, entropy_coefficient: Array | float) -> Array:
    """The scalar to minimise, from means (or sums) in the order of LOSS_METRICS."""
    return terms[0] + value_coefficient * terms[1] - entropy_coefficient * terms[2]
