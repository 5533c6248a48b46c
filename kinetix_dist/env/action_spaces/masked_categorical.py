"""Independent categorical choices of which some may be forbidden: a forbidden choice has probability 0.

Heads differ much in size (2 to 127 choices), so that each is handled on its own, in float32.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jax2d.scene import Array

FORBIDDEN_LOGIT = -1e30  # its probability is exactly 0 in float32
MAX_CHOICES = 127  # of a head, as actions are stored


@dataclasses.dataclass(frozen=True, kw_only=True)
class MaskedCategorical:
    """An `ActionDistribution`: one choice of each head, from its logits. See `forbid`."""

    head_sizes: tuple[int, ...]
    stored_dtype: ClassVar[Any] = jnp.int8

    def __post_init__(self) -> None:
        if max(self.head_sizes) > MAX_CHOICES:
            raise ValueError(f"a head has {max(self.head_sizes)} choices; at most {MAX_CHOICES} can be stored")

    @property
    def num_uniforms(self) -> int:
        return len(self.head_sizes)

    def sample(self, outputs: tuple[Array, ...], uniforms: Array) -> tuple[Array, Array]:
        """Actions [..., heads] int32 and their log-probability [...] from uniform numbers [..., heads] in [0, 1)."""
        actions, total = [], jnp.zeros(uniforms.shape[:-1], jnp.float32)
        for head, logits in enumerate(outputs):
            log_probs = jax.nn.log_softmax(logits.astype(jnp.float32))
            choice = jnp.sum(uniforms[..., head, None] >= jnp.cumsum(jnp.exp(log_probs), axis=-1), axis=-1)
            # Rounding can leave the sum of probabilities below 1: never step past the last choice that is allowed.
            is_allowed = logits > 0.5 * FORBIDDEN_LOGIT
            last = logits.shape[-1] - 1 - jnp.argmax(is_allowed[..., ::-1], axis=-1)
            choice = jnp.minimum(choice, last)
            actions.append(choice.astype(jnp.int32))
            total = total + _at(log_probs, choice)
        return jnp.stack(actions, axis=-1), total

    def log_prob_and_entropy(self, outputs: tuple[Array, ...], actions: Array) -> tuple[Array, Array]:
        """Both summed over heads: (log-probability [...], entropy [...] in nats)."""
        log_prob = entropy = jnp.zeros(actions.shape[:-1], jnp.float32)
        for head, logits in enumerate(outputs):
            log_probs = jax.nn.log_softmax(logits.astype(jnp.float32))
            log_prob = log_prob + _at(log_probs, actions[..., head].astype(jnp.int32))
            # Forbidden choices: probability 0 times a finite log-probability is 0.
            entropy = entropy - jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1)
        return log_prob, entropy

    def mode(self, outputs: tuple[Array, ...]) -> Array:
        """The most likely actions [..., heads] int32."""
        return jnp.stack([jnp.argmax(logits, axis=-1) for logits in outputs], axis=-1).astype(jnp.int32)


def forbid(outputs: tuple[Array, ...], allowed: tuple[Array, ...]) -> tuple[Array, ...]:
    """Logits of each head with those of choices that are not allowed (bool, as large) at FORBIDDEN_LOGIT."""
    return tuple(jnp.where(may, logits, FORBIDDEN_LOGIT) for logits, may in zip(outputs, allowed, strict=True))


def _at(log_probs: Array, choice: Array) -> Array:
    """Picked by a sum: its gradient needs no scatter."""
    return jnp.sum(jnp.where(choice[..., None] == jnp.arange(log_probs.shape[-1]), log_probs, 0.0), axis=-1)
