"""Independent numbers in a range, each from a normal distribution cut off at its ends and scaled to one again.

    density(x) = phi((x - mean) / spread) / (spread Z)    low <= x <= high,  Z = Phi(beta) - Phi(alpha)
    alpha = (low - mean) / spread, beta = (high - mean) / spread

phi and Phi are density and distribution of the standard normal. Unlike a normal that is clipped or squashed, it has a
density everywhere in the range, its entropy in closed form, and one uniform number makes a sample: Phi of it is uniform
between Phi(alpha) and Phi(beta). The mean lies in the range (a tanh of the first output), so that Z is never small, and
the spread between 1/20 and 5 of half the range (the second output): from almost certain to almost uniform.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from jax2d.scene import Array

MIN_SPREAD = 0.05  # of half the range
MAX_SPREAD = 5.0
_LOG_ROOT_2_PI = 0.5 * math.log(2 * math.pi)
# Shares of Phi that float32 tells from 0 and 1: a sample is at most 5 spreads from the mean.
_MIN_SHARE = 1e-6


@dataclasses.dataclass(frozen=True, kw_only=True)
class TruncatedNormal:
    """An `ActionDistribution`: a number in each range, from outputs for its mean and for its spread."""

    low: tuple[float, ...]
    high: tuple[float, ...]
    stored_dtype: ClassVar[Any] = jnp.float32

    @property
    def head_sizes(self) -> tuple[int, int]:
        """Outputs for means, outputs for spreads."""
        return len(self.low), len(self.low)

    @property
    def num_uniforms(self) -> int:
        return len(self.low)

    def sample(self, outputs: tuple[Array, ...], uniforms: Array, *, bound: Array | None = None) -> tuple[Array, Array]:
        """Actions [..., n] float32 and their log-probability density [...], from uniform numbers [..., n] in [0, 1)."""
        mean, spread = self.mean_and_spread(outputs)
        below, above = self._ends(mean, spread)
        share = _distribution(below) + uniforms * (_distribution(above) - _distribution(below))
        share = jnp.clip(share, _MIN_SHARE, 1 - _MIN_SHARE)
        actions = mean + spread * jax.scipy.special.ndtri(share)
        actions = jnp.clip(actions, *self._range())  # rounding
        return actions, self._log_prob(mean, spread, actions, bound)

    def log_prob_and_entropy(
        self, outputs: tuple[Array, ...], actions: Array, *, bound: Array | None = None
    ) -> tuple[Array, Array]:
        """Both summed over numbers: (log-probability density [...], differential entropy [...] in nats)."""
        mean, spread = self.mean_and_spread(outputs)
        below, above = self._ends(mean, spread)
        mass = _distribution(above) - _distribution(below)
        # ln(sqrt(2 pi e) spread Z) + (alpha phi(alpha) - beta phi(beta)) / (2 Z)
        entropy = 0.5 + _LOG_ROOT_2_PI + jnp.log(spread * mass)
        entropy += (below * _density(below) - above * _density(above)) / (2 * mass)
        return self._log_prob(mean, spread, actions, bound), _sum_of_bound(entropy, bound)

    def mode(self, outputs: tuple[Array, ...]) -> Array:
        """The most likely actions [..., n] float32: the means."""
        return self.mean_and_spread(outputs)[0]

    def mean_and_spread(self, outputs: tuple[Array, ...]) -> tuple[Array, Array]:
        """Mean and spread before truncation, [..., n] each; outputs of 0 give the middle and half of half the range."""
        low, high = self._range()
        half = 0.5 * (high - low)
        towards_end, width = (output.astype(jnp.float32) for output in outputs)
        exponent = math.log(MIN_SPREAD) + math.log(MAX_SPREAD / MIN_SPREAD) * jax.nn.sigmoid(width)
        return 0.5 * (low + high) + half * jnp.tanh(towards_end), half * jnp.exp(exponent)

    def _range(self) -> tuple[np.ndarray, np.ndarray]:
        return np.asarray(self.low, np.float32), np.asarray(self.high, np.float32)

    def _ends(self, mean: Array, spread: Array) -> tuple[Array, Array]:
        """alpha and beta: how many spreads the ends of the range are from the mean."""
        low, high = self._range()
        return (low - mean) / spread, (high - mean) / spread

    def _log_prob(self, mean: Array, spread: Array, actions: Array, bound: Array | None) -> Array:
        below, above = self._ends(mean, spread)
        mass = _distribution(above) - _distribution(below)
        deviation = (actions.astype(jnp.float32) - mean) / spread
        return _sum_of_bound(-0.5 * jnp.square(deviation) - _LOG_ROOT_2_PI - jnp.log(spread * mass), bound)


def _sum_of_bound(x: Array, bound: Array | None) -> Array:
    return jnp.sum(x if bound is None else jnp.where(bound, x, 0.0), axis=-1)


def _distribution(x: Array) -> Array:
    return jax.scipy.special.ndtr(x)


def _density(x: Array) -> Array:
    return jnp.exp(-0.5 * jnp.square(x) - _LOG_ROOT_2_PI)
