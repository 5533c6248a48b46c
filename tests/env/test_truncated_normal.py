"""Distributions of continuous and discrete actions compared with those of scipy."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from kinetix_dist.env.action_spaces import ACTION_SPACES, ActionSpace
from kinetix_dist.env.action_spaces.truncated_normal import MAX_SPREAD, MIN_SPREAD
from tests.helpers import present

CONTINUOUS, DISCRETE = ACTION_SPACES["continuous"], ACTION_SPACES["discrete"]
NUMBERS = present(CONTINUOUS.distribution)
HALF = 0.5 * (np.array(CONTINUOUS.high) - CONTINUOUS.low)


def random_outputs(space: ActionSpace, count: int, scale: float = 2.0) -> tuple[jax.Array, ...]:
    keys = jax.random.split(jax.random.key(1), len(present(space.distribution).head_sizes))
    return tuple(scale * jax.random.normal(k, (count, n)) for k, n in zip(keys, present(space.distribution).head_sizes))


def drawn(space: ActionSpace, outputs: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
    shape = (outputs[0].shape[0], present(space.distribution).num_uniforms)
    return present(space.distribution).sample(outputs, jax.random.uniform(jax.random.key(2), shape))


def of_scipy(outputs: tuple[jax.Array, ...]) -> Any:
    """Means and spreads by hand, in float64."""
    first, second = (np.asarray(output, float) for output in outputs)
    mean = 0.5 * (np.array(CONTINUOUS.high) + CONTINUOUS.low) + HALF * np.tanh(first)
    share = 1 / (1 + np.exp(-second))
    spread = HALF * MIN_SPREAD * (MAX_SPREAD / MIN_SPREAD) ** share
    ends = [(np.array(end) - mean) / spread for end in (CONTINUOUS.low, CONTINUOUS.high)]
    return stats.truncnorm(ends[0], ends[1], loc=mean, scale=spread)


def test_log_probability_and_entropy_are_those_of_scipy():
    outputs = random_outputs(CONTINUOUS, 500)
    actions, log_prob = drawn(CONTINUOUS, outputs)
    again, entropy = NUMBERS.log_prob_and_entropy(outputs, actions)
    expected = of_scipy(outputs)
    np.testing.assert_allclose(log_prob, expected.logpdf(np.asarray(actions, float)).sum(-1), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(entropy, expected.entropy().sum(-1), rtol=1e-4, atol=1e-3)  # float32, differences of Phi
    np.testing.assert_array_equal(log_prob, again)


def test_samples_follow_the_distribution_of_scipy():
    """Kolmogorov and Smirnov: of 6 x 20,000 samples, each number with its own mean and spread."""
    outputs = tuple(jnp.repeat(output, 20_000, axis=0) for output in random_outputs(CONTINUOUS, 1))
    actions, _ = drawn(CONTINUOUS, outputs)
    CONTINUOUS.check(actions, 20_000)
    shares = of_scipy(outputs).cdf(np.asarray(actions, float))
    for number in range(6):
        assert stats.kstest(shares[:, number], "uniform").pvalue > 1e-3


@pytest.mark.parametrize("first", [-50.0, 0.0, 50.0])
@pytest.mark.parametrize("second", [-50.0, 0.0, 50.0])
@pytest.mark.parametrize("uniform", [0.0, 0.5, float(np.nextafter(np.float32(1), np.float32(0)))])
def test_extreme_outputs_stay_in_range_with_finite_gradients(first: float, second: float, uniform: float):
    outputs = (jnp.full((1, 6), first), jnp.full((1, 6), second))
    actions, log_prob = NUMBERS.sample(outputs, jnp.full((1, 6), uniform))
    CONTINUOUS.check(actions, 1)
    assert -100 < float(log_prob[0]) < 100
    grads = jax.grad(lambda x: sum(part.sum() for part in NUMBERS.log_prob_and_entropy(x, actions)))(outputs)
    assert all(bool(jnp.isfinite(grad).all()) for grad in grads)
    CONTINUOUS.check(NUMBERS.mode(outputs), 1)


def test_the_density_is_largest_at_the_mode():
    outputs = random_outputs(CONTINUOUS, 200)
    mode = NUMBERS.mode(outputs)
    best, _ = NUMBERS.log_prob_and_entropy(outputs, mode)
    found, _ = NUMBERS.log_prob_and_entropy(outputs, drawn(CONTINUOUS, outputs)[0])
    assert (found <= best + 1e-4).all()


def test_one_choice_of_eleven_has_the_log_probability_and_entropy_of_scipy():
    outputs = random_outputs(DISCRETE, 300)
    actions, log_prob = drawn(DISCRETE, outputs)
    DISCRETE.check(actions, 300)
    logits = np.asarray(outputs[0], float)
    chances = np.exp(logits) / np.exp(logits).sum(-1, keepdims=True)
    again, entropy = present(DISCRETE.distribution).log_prob_and_entropy(outputs, actions.astype(jnp.int8))
    np.testing.assert_allclose(log_prob, np.log(chances[np.arange(300), actions]), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(entropy, stats.entropy(chances, axis=-1), rtol=1e-5)
    np.testing.assert_array_equal(log_prob, again)
    np.testing.assert_array_equal(present(DISCRETE.distribution).mode(outputs), logits.argmax(-1))
    many = present(DISCRETE.distribution).sample(
        (jnp.repeat(outputs[0][:1], 20_000, 0),), jax.random.uniform(jax.random.key(3), (20_000, 1))
    )[0]
    np.testing.assert_allclose(np.bincount(many, minlength=11) / 20_000, chances[0], atol=0.015)  # 4 standard errors
