"""Flow matching: samples of a known Gaussian have its mean and variance; prefixes and weights count as they say."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from kinetix_dist import prng
from kinetix_dist.delay.flow_matching import Draw, draw, flow_loss, integrate, integrate_after, interpolated

MEAN, DEVIATION = 0.3, 0.4


def gaussian_velocity(x, time):
    """E[action - noise | x_t = x] of actions from N(MEAN, DEVIATION^2): both are linear in x, and so is x_t."""
    t = time[..., None]
    variance = (1 - t) ** 2 + (t * DEVIATION) ** 2
    deviation = x - t * MEAN
    return MEAN + (t * DEVIATION**2 - (1 - t)) / variance * deviation


def test_a_flow_of_a_known_gaussian_gives_its_mean_and_variance() -> None:
    samples = integrate(gaussian_velocity, prng.normal(prng.key(0), (4000, 2, 3)), 200)
    # 24,000 samples: standard errors 0.0026 and 0.0018; 200 steps of Euler are off by less
    assert np.mean(samples) == pytest.approx(MEAN, abs=0.012)
    assert np.std(samples) == pytest.approx(DEVIATION, abs=0.012)


def test_the_velocity_that_the_loss_is_least_for_is_that_of_the_gaussian() -> None:
    actions = MEAN + DEVIATION * prng.normal(prng.key(1), (20_000, 2, 1))
    drawn = draw(prng.key(2), (20_000, 2, 1), 0)
    ones = jnp.ones_like(actions)
    best = flow_loss(gaussian_velocity, actions, drawn, ones)
    for change in (0.1, -0.1):
        assert flow_loss(lambda x, t, c=change: gaussian_velocity(x, t) + c, actions, drawn, ones) > best
        assert flow_loss(lambda x, t, c=change: gaussian_velocity(x, t) + c * x, actions, drawn, ones) > best


def test_the_loss_by_hand() -> None:
    """Two actions, the first given: only the second counts, at its time and with its weight."""
    actions, noise = jnp.array([[[0.5], [0.8]]]), jnp.array([[[9.0], [-0.2]]])
    seen = {}

    def velocity(x, time):
        seen.update(x=np.asarray(x), time=np.asarray(time))
        return jnp.full_like(x, 0.4)

    loss = flow_loss(velocity, actions, Draw(noise, jnp.array([0.25]), jnp.array([1])), jnp.ones_like(actions))
    np.testing.assert_allclose(seen["time"], [[1.0, 0.25]])
    np.testing.assert_allclose(seen["x"][0, :, 0], [0.5, 0.75 * -0.2 + 0.25 * 0.8])
    assert float(loss) == pytest.approx((0.4 - (0.8 + 0.2)) ** 2)


def test_what_does_not_count_changes_no_loss() -> None:
    weight = jnp.array([[[1.0, 0.0], [0.0, 0.0]]])
    drawn = draw(prng.key(3), (1, 2, 2), 0)
    actions = jnp.zeros((1, 2, 2))
    other = actions.at[0, 0, 1].set(5.0).at[0, 1].set(7.0)

    def still(x, time):
        return jnp.zeros_like(x)

    assert flow_loss(still, actions, drawn, weight) == flow_loss(still, other, drawn, weight)
    assert flow_loss(still, actions, drawn, 0 * weight) == 0.0  # of nothing that counts


def test_given_actions_come_out_as_they_are_and_the_flow_sees_them_without_noise() -> None:
    given = jnp.array([[[0.1], [0.2], [0.3]]])

    def follows_the_first(x, time):
        """Towards the first action, which it sees."""
        return (x[:, :1] - x) / jnp.maximum(1 - time[..., None], 1e-3)

    noise = prng.normal(prng.key(4), (1, 3, 1))
    made = integrate_after(follows_the_first, noise, 10, given, jnp.array([True, False, False]))
    np.testing.assert_allclose(made[0, :, 0], [0.1, 0.1, 0.1], atol=1e-5)
    free = integrate_after(gaussian_velocity, noise, 10, given, jnp.zeros(3, bool))
    np.testing.assert_allclose(free, integrate(gaussian_velocity, noise, 10), rtol=1e-5)  # rounding


def test_interpolation_has_noise_at_zero_and_the_action_at_one() -> None:
    noise, action = jnp.full((1, 3, 1), -1.0), jnp.full((1, 3, 1), 2.0)
    np.testing.assert_allclose(interpolated(noise, action, jnp.array([[0.0, 0.5, 1.0]]))[0, :, 0], [-1.0, 0.5, 2.0])


def test_prefixes_are_drawn_up_to_the_longest() -> None:
    prefix = np.asarray(draw(prng.key(5), (3000, 4, 1), 3).prefix)
    np.testing.assert_allclose(np.bincount(prefix, minlength=4) / 3000, 0.25, atol=0.04)  # 4 standard errors: 0.032
    assert np.asarray(draw(prng.key(5), (100, 4, 1), 0).prefix).max() == 0
