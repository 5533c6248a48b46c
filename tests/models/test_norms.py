"""Norms and means of the transformer against the formulas, differentiated by jax in float64; what a GPU stores."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist.models.linear import stored, stored_gradient
from kinetix_dist.models.norms import NORM_EPSILON, masked_mean, norm_branch, normalise

X = np.random.default_rng(0).normal(1.0, 2.0, (3, 5, 8))
MASK = np.array([[True, False, True, True, True], [False, False, False, False, True], [True] * 5])


def _norm(x: jax.Array) -> jax.Array:
    return (x - x.mean(-1, keepdims=True)) / jnp.sqrt(x.var(-1, keepdims=True) + NORM_EPSILON)


def _mean(x: jax.Array) -> jax.Array:
    return (x * MASK[..., None]).sum(1) / MASK.sum(1)[:, None]


@pytest.mark.parametrize(
    "ours, formula",
    [
        (normalise, _norm),
        (lambda x: jnp.stack(norm_branch(x)), lambda x: jnp.stack([x, _norm(x)])),
        (lambda x: masked_mean(x, jnp.asarray(MASK)), _mean),
        (stored_gradient, lambda x: x),
    ],
    ids=["normalise", "norm_branch", "masked_mean", "stored_gradient"],
)
def test_value_and_gradient_are_those_of_the_formula(ours: Callable, formula: Callable) -> None:
    with jax.enable_x64(True):
        expected, backward = jax.vjp(formula, jnp.asarray(X))
        cotangent = jnp.cos(jnp.arange(expected.size, dtype=jnp.float64)).reshape(expected.shape)
        (expected_grad,) = backward(cotangent)
    found, backward = jax.vjp(ours, jnp.asarray(X, jnp.float32))
    (grad,) = backward(jnp.asarray(cotangent, jnp.float32))
    assert found.dtype == grad.dtype == jnp.float32
    np.testing.assert_allclose(found, expected, rtol=2e-5, atol=2e-6)
    np.testing.assert_allclose(grad, expected_grad, rtol=2e-5, atol=2e-6)


def test_a_gpu_stores_and_a_cpu_does_not() -> None:
    traced = jax.jit(lambda x: stored((x + 1, x))[0] * 2).trace(jnp.ones(3))
    barrier = "optimization_barrier"
    assert barrier in traced.lower(lowering_platforms=("cuda",)).as_text()
    assert barrier not in traced.lower(lowering_platforms=("cpu",)).as_text()
