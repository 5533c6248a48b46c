"""Independent categorical choices: sample, log-probability and entropy.

Heads differ in size (3, 3, 3, 3, 2, 2). They are padded to one width with choices of probability zero and handled
together, choice by choice, so that everything here is one elementwise loop over worlds instead of a reduction a head.
All in float32.
"""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from jax2d.scene import Array

_ABSENT_LOGIT = -1e30  # its probability is exactly 0 in float32


@dataclasses.dataclass(frozen=True, kw_only=True)
class Categorical:
    """An `ActionDistribution`: one choice of each head, from its logits."""

    head_sizes: tuple[int, ...]  # at most 127 choices
    stored_dtype: ClassVar[Any] = jnp.int8

    @property
    def num_uniforms(self) -> int:
        return len(self.head_sizes)

    def sample(self, outputs: tuple[Array, ...], uniforms: Array, *, bound: Array | None = None) -> tuple[Array, Array]:
        """Actions [..., heads] int32 and their log-probability [...] from uniform numbers [..., heads] in [0, 1)."""
        log_probs = _log_probabilities(outputs)
        actions = jnp.zeros(uniforms.shape, jnp.int32)
        cumulative = jnp.zeros_like(log_probs[0])
        last_choice = jnp.asarray([head.shape[-1] - 1 for head in outputs], jnp.int32)
        for lp in log_probs[:-1]:
            cumulative = cumulative + jnp.exp(lp)
            actions = actions + (uniforms >= cumulative).astype(jnp.int32)
        # Rounding can leave the sum of probabilities below 1: never step past the last choice of a head.
        actions = jnp.minimum(actions, last_choice)
        return actions, _log_prob(log_probs, actions, bound)

    def log_prob_and_entropy(
        self, outputs: tuple[Array, ...], actions: Array, *, bound: Array | None = None
    ) -> tuple[Array, Array]:
        """Both from one normalisation, summed over heads: (log-probability [...], entropy [...] in nats)."""
        log_probs = _log_probabilities(outputs)
        log_prob = _log_prob(log_probs, actions, bound)
        # Absent choices: probability 0 times a finite log-probability is 0.
        return log_prob, -_sum_heads(sum(jnp.exp(lp) * lp for lp in log_probs), bound)

    def mode(self, outputs: tuple[Array, ...]) -> Array:
        """The most likely actions [..., heads] int32."""
        return jnp.stack([jnp.argmax(head, axis=-1) for head in outputs], axis=-1).astype(jnp.int32)


@dataclasses.dataclass(frozen=True, kw_only=True)
class OneCategorical:
    """An `ActionDistribution`: one choice, without an axis for it: actions are [...]."""

    num_choices: int  # at most 127
    stored_dtype: ClassVar[Any] = jnp.int8

    @property
    def num_uniforms(self) -> int:
        return 1

    @property
    def head_sizes(self) -> tuple[int]:
        return (self.num_choices,)

    def sample(self, outputs: tuple[Array, ...], uniforms: Array, *, bound: Array | None = None) -> tuple[Array, Array]:
        """Actions [...] int32 and their log-probability [...] from uniform numbers [..., 1] in [0, 1)."""
        actions, log_prob = self._heads.sample(outputs, uniforms, bound=bound)
        return actions[..., 0], log_prob

    def log_prob_and_entropy(
        self, outputs: tuple[Array, ...], actions: Array, *, bound: Array | None = None
    ) -> tuple[Array, Array]:
        """(log-probability [...], entropy [...] in nats)."""
        return self._heads.log_prob_and_entropy(outputs, actions[..., None], bound=bound)

    def mode(self, outputs: tuple[Array, ...]) -> Array:
        """The most likely action [...] int32."""
        return self._heads.mode(outputs)[..., 0]

    @property
    def _heads(self) -> Categorical:
        return Categorical(head_sizes=self.head_sizes)


def _log_prob(log_probs: list[Array], actions: Array, bound: Array | None) -> Array:
    return _sum_heads(sum(jnp.where(actions == choice, lp, 0.0) for choice, lp in enumerate(log_probs)), bound)


def _log_probabilities(logits: tuple[Array, ...]) -> list[Array]:
    """Log-probability of choice 0, 1, ... of every head: a list of [..., heads]."""
    width = max(head.shape[-1] for head in logits)
    choices = [
        jnp.stack(
            [
                head[..., c].astype(jnp.float32)
                if c < head.shape[-1]
                else jnp.full(head.shape[:-1], _ABSENT_LOGIT, jnp.float32)
                for head in logits
            ],
            axis=-1,
        )
        for c in range(width)
    ]
    highest = choices[0]
    for choice in choices[1:]:
        highest = jnp.maximum(highest, choice)
    highest = jax.lax.stop_gradient(highest)
    log_total = highest + jnp.log(sum(jnp.exp(choice - highest) for choice in choices))
    return [choice - log_total for choice in choices]


def _sum_heads(x: Array, bound: Array | None) -> Array:
    """[..., heads] -> [...], over those that are bound (bool, as large); None: over all, in order."""
    if bound is not None:
        x = jnp.where(bound, x, 0.0)
    total = x[..., 0]
    for head in range(1, x.shape[-1]):
        total = total + x[..., head]
    return total
