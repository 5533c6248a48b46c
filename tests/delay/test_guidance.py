"""RTC: the soft mask and the weight of guidance by hand, and chunks that keep to the old one."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.delay.flow_matching import integrate
from kinetix_dist.delay.guidance import guidance_weight, guided, soft_weights


def test_the_soft_mask_by_hand() -> None:
    """Eq. 5 of the paper with H = 8, s = 3, d = 2: c = 3/4, 2/4, 1/4 of actions 2 to 4."""
    c = np.array([0.75, 0.5, 0.25])
    expected = [1, 1, *(c * (np.exp(c) - 1) / (math.e - 1)), 0, 0, 0]
    np.testing.assert_allclose(soft_weights(2, 5, 8), expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("delay", "known", "expected"), [(0, 0, [0, 0, 0, 0]), (2, 2, [1, 1, 0, 0]), (4, 4, [1, 1, 1, 1])]
)
def test_a_mask_without_a_soft_part(delay: int, known: int, expected: list[float]) -> None:
    np.testing.assert_array_equal(soft_weights(delay, known, 4), expected)


def test_the_weight_of_guidance_by_hand() -> None:
    """(1 - t) / (t r^2) with r^2 = (1 - t)^2 / (t^2 + (1 - t)^2): at t = 1/2, r^2 = 1/2 and 1 / (1/2) = 2."""
    t = np.array([0.2, 0.5, 0.9])
    r2 = (1 - t) ** 2 / (t**2 + (1 - t) ** 2)
    np.testing.assert_allclose(guidance_weight(jnp.asarray(t), 100.0), (1 - t) / (t * r2), rtol=1e-5)
    assert float(guidance_weight(jnp.float32(0.5))) == pytest.approx(2.0)
    np.testing.assert_allclose(guidance_weight(jnp.array([0.0, 1.0]), 5.0), 5.0)


def test_a_full_mask_reproduces_the_old_chunk() -> None:
    """Of a flow that leaves noise as it is, x1 = x and J is the identity: each of K = beta steps ends at the target."""
    old = jnp.linspace(-1.0, 1.0, 8).reshape(1, 4, 2)

    def still(x, time):
        return jnp.zeros_like(x)

    noise = prng.normal(prng.key(0), old.shape)
    made = integrate(guided(still, old, jnp.ones((4, 1))), noise, 5)
    np.testing.assert_allclose(made, old, atol=1e-6)
    half = integrate(guided(still, old, jnp.array([1.0, 1.0, 0.0, 0.0])[:, None]), noise, 5)
    np.testing.assert_allclose(half[:, :2], old[:, :2], atol=1e-6)
    np.testing.assert_array_equal(half[:, 2:], noise[:, 2:])


def test_guidance_against_its_formula_with_a_matrix() -> None:
    """v = M x: J = I + (1 - t) M, which mixes actions, and the pull is J^T W (Y - x1)."""
    matrix = np.array([[0.3, -0.5], [0.8, 0.1]], np.float32)
    x, y, weights, t = np.array([0.4, -0.6]), np.array([-0.2, 0.9]), np.array([1.0, 0.3]), 0.3

    def velocity(x, time):
        return jnp.einsum("ij,bja->bia", matrix, x)

    found = guided(velocity, jnp.asarray(y).reshape(1, 2, 1), jnp.asarray(weights)[:, None], 50.0)(
        jnp.asarray(x, jnp.float32).reshape(1, 2, 1), jnp.full((1, 2), t)
    )
    jacobian = np.eye(2) + (1 - t) * matrix
    estimate = x + (1 - t) * matrix @ x
    weight = (t**2 + (1 - t) ** 2) / (t * (1 - t))
    np.testing.assert_allclose(found[0, :, 0], matrix @ x + weight * jacobian.T @ (weights * (y - estimate)), rtol=1e-5)


def test_without_a_mask_guidance_changes_nothing() -> None:
    noise = prng.normal(prng.key(1), (2, 4, 3))

    def velocity(x, time):
        return 0.5 - x

    np.testing.assert_allclose(
        integrate(guided(velocity, jnp.ones((2, 4, 3)), jnp.zeros((4, 1))), noise, 5),
        integrate(velocity, noise, 5),
        atol=1e-6,
    )
